"""XML scenes: sensor and film conversion, what is refused and with which words."""

from pathlib import Path

import numpy as np
import pytest

from workers.backend import mi
from workers.camera import Camera
from workers.errors import SceneError
from workers.scene import load_scene

LIGHT = '<emitter type="constant"/>'
FLOOR = '<shape type="rectangle"><transform name="to_world"><scale value="3"/></transform></shape>'
SENSOR = """<sensor type="perspective"><float name="fov" value="40"/>{more}
<transform name="to_world"><lookat origin="0,1,5" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="60"/><integer name="height" value="30"/></film></sensor>"""
PLY_SHAPE = '<shape type="ply"><string name="filename" value="mesh.ply"/></shape>'
TRIANGLE = "ply\nformat ascii 1.0\nelement vertex {n}\nproperty float x\nproperty float y\nproperty float z\n"
TRIANGLE += "element face {m}\nproperty list uchar int vertex_indices\nend_header\n"


def write(folder: Path, *parts: str, name: str = "room.xml") -> Path:
    path = folder / name
    path.write_text('<scene version="3.0.0">' + "".join(parts) + "</scene>")
    return path


def write_ply(folder: Path, vertices: list, faces: list) -> str:
    text = TRIANGLE.format(n=len(vertices), m=len(faces))
    if not np.isfinite(vertices).all():
        binary = text.replace("ascii", "binary_little_endian").encode() + np.array(vertices, dtype="<f4").tobytes()
        binary += b"".join(b"\x03" + np.array(face, dtype="<i4").tobytes() for face in faces)
        (folder / "mesh.ply").write_bytes(binary)
        return PLY_SHAPE
    text += "".join(" ".join(map(str, vertex)) + "\n" for vertex in vertices)
    text += "".join("3 " + " ".join(map(str, face)) + "\n" for face in faces)
    (folder / "mesh.ply").write_text(text)
    return PLY_SHAPE


def sensor(more: str = "") -> str:
    return SENSOR.format(more=more)


def test_film_gives_the_default_size_and_aspect(tmp_path: Path) -> None:
    path = write(tmp_path, sensor(), FLOOR, LIGHT)
    assert (load_scene(path).camera.width, load_scene(path).camera.height) == (60, 30)
    camera = load_scene(path, height=100).camera
    assert (camera.width, camera.height) == (200, 100)


def test_vertical_fov_is_converted_for_the_asked_size(tmp_path: Path) -> None:
    scene = load_scene(
        write(tmp_path, sensor('<string name="fov_axis" value="y"/>'), FLOOR, LIGHT), width=90, height=30
    )
    assert scene.camera.fov_deg == pytest.approx(np.degrees(2 * np.arctan(3 * np.tan(np.radians(20)))), rel=1e-5)
    assert scene.camera.fov_y_deg == pytest.approx(40, rel=1e-5)


def test_default_parameters_and_depth_come_from_the_file(tmp_path: Path) -> None:
    defaults = '<default name="resx" value="7"/><default name="max_depth" value="5"/>'
    integrator = '<integrator type="path"><integer name="max_depth" value="$max_depth"/></integrator>'
    film = sensor().replace('name="width" value="60"', 'name="width" value="$resx"')
    path = write(tmp_path, defaults, integrator, film, FLOOR, LIGHT)
    scene = load_scene(path, height=11)
    assert scene.max_depth == 5
    assert load_scene(path).camera.width == 7
    assert load_scene(path, max_depth=-1).max_depth == -1
    assert load_scene(write(tmp_path, sensor(), FLOOR, LIGHT, name="b.xml")).max_depth == 12
    with pytest.raises(SceneError, match="max_depth"):
        load_scene(path, max_depth=0)


def test_make_sensor_rays_follow_the_camera(tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path, sensor(), FLOOR, LIGHT))
    built = scene.make_sensor(scene.camera, 2)
    ray, _ = built.sample_ray(0, 0.5, mi.Point2f(0.5, 0.5), 0.5)
    np.testing.assert_allclose(np.array(ray.d).ravel(), scene.camera.forward, atol=1e-6)
    left, _ = built.sample_ray(0, 0.5, mi.Point2f(0.0, 0.5), 0.5)
    local = scene.camera.world_to_camera[:3, :3] @ np.array(left.d, dtype=np.float64).ravel()
    assert local[0] / local[2] == pytest.approx(np.tan(np.radians(20)), rel=1e-5)  # +X is image left
    assert tuple(built.film().size()) == (60, 30)


def test_sensor_scale_is_taken_out_and_noted(tmp_path: Path) -> None:
    scaled = sensor().replace("<lookat", '<scale value="3"/><lookat')
    scene = load_scene(write(tmp_path, scaled, FLOOR, LIGHT))
    expected = Camera.look_at([0, 1, 5], [0, 0, 0], [0, 1, 0], 40, 60, 30)
    np.testing.assert_allclose(scene.camera.to_world, expected.to_world, atol=1e-6)
    assert any("scale" in note for note in scene.notes)


def test_shapes_are_named_by_their_place_and_not_merged(tmp_path: Path) -> None:
    named = FLOOR.replace("<shape", '<shape id="own"')
    scene = load_scene(write(tmp_path, sensor(), FLOOR, named, FLOOR, LIGHT))
    assert sorted(shape.id() for shape in scene.mi_scene.shapes()) == ["own", "shape-00000", "shape-00002"]


def test_digest_follows_content_not_size_or_place(tmp_path: Path) -> None:
    mesh = write_ply(tmp_path, [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    path = write(tmp_path, sensor(), mesh, LIGHT)
    first = load_scene(path).digest
    assert load_scene(path, width=5, height=5).digest == first
    assert load_scene(path, max_depth=3).digest != first
    copy = tmp_path / "copy"
    copy.mkdir()
    for name in ("room.xml", "mesh.ply"):
        (copy / name).write_bytes((tmp_path / name).read_bytes())
    assert load_scene(copy / "room.xml").digest == first
    write_ply(tmp_path, [(0, 0, 0), (2, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    assert load_scene(path).digest != first


def test_included_files_count(tmp_path: Path) -> None:
    (tmp_path / "more.xml").write_text(f'<scene version="3.0.0">{FLOOR}</scene>')
    path = write(tmp_path, sensor(), LIGHT, '<include filename="more.xml"/>')
    first = load_scene(path)
    assert len(first.mi_scene.shapes()) == 1
    (tmp_path / "more.xml").write_text(f'<scene version="3.0.0">{FLOOR} </scene>')
    assert load_scene(path).digest != first.digest


def test_name_is_the_folder_of_a_scene_xml(tmp_path: Path) -> None:
    folder = tmp_path / "My Hall"
    folder.mkdir()
    path = write(folder, sensor(), FLOOR, LIGHT, name="scene.xml")
    assert load_scene(path).name == "my-hall"
    assert load_scene(folder).name == "my-hall"


def test_thinlens_and_second_sensor_are_noted(tmp_path: Path) -> None:
    lens = sensor('<float name="aperture_radius" value="0.1"/>').replace('"perspective"', '"thinlens"')
    scene = load_scene(write(tmp_path, lens, '<sensor type="orthographic"/>', FLOOR, LIGHT))
    assert scene.camera.fov_deg == pytest.approx(40)
    assert any("pinhole" in note for note in scene.notes) and any("2 sensors" in note for note in scene.notes)


def test_near_clip_of_the_file_is_kept(tmp_path: Path) -> None:
    assert load_scene(write(tmp_path, sensor('<float name="near_clip" value="2"/>'), FLOOR, LIGHT)).near_clip == 2


def test_some_triangles_without_area_are_noted(tmp_path: Path) -> None:
    mesh = write_ply(tmp_path, [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2), (0, 1, 1)])
    assert "1 triangles have no area" in load_scene(write(tmp_path, sensor(), mesh, LIGHT)).notes[0]


REFUSED = {
    "no sensor": ([FLOOR, LIGHT], "must hold a sensor"),
    "no light": ([sensor(), FLOOR], "must hold a light"),
    "no shape": ([sensor(), LIGHT], "at least one shape"),
    "sensor type": ([sensor().replace('"perspective"', '"orthographic"'), FLOOR, LIGHT], "got orthographic"),
    "instance of nothing": ([sensor(), FLOOR, '<shape type="instance"/>', LIGHT], "one shapegroup, got 0"),
    "group in a group": (
        [
            sensor(),
            '<shape type="shapegroup" id="a"><shape type="shapegroup" id="b"/></shape>',
            FLOOR,
            '<shape type="instance"><ref id="a"/></shape>',
            LIGHT,
        ],
        "plain shapes",
    ),
    "unknown plugin": ([sensor(), '<shape type="pyramid"/>', LIGHT], "pyramid"),
    "unknown parameter": (
        [sensor(), FLOOR, '<emitter type="constant"><float name="glow" value="1"/></emitter>'],
        "glow",
    ),
    "missing file": (
        [sensor(), '<shape type="ply"><string name="filename" value="gone.ply"/></shape>'],
        "gone.ply",
    ),
    "broken XML": (["<shape"], "valid Mitsuba scene"),
    "dangling reference": ([sensor(), '<shape type="cube"><ref id="nowhere"/></shape>', LIGHT], "nowhere"),
    "undefined parameter": ([sensor().replace('"40"', '"$zoom"'), FLOOR, LIGHT], "zoom"),
    "bad fov": ([sensor().replace('"40"', '"200"'), FLOOR, LIGHT], "field of view"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_xml_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    parts, message = REFUSED[case]
    with pytest.raises(SceneError, match=message) as caught:
        load_scene(write(tmp_path, *parts))
    assert "\n" not in str(caught.value) and ".cpp" not in str(caught.value)


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        ([(0, 0, 0), (np.nan, 0, 0), (0, 1, 0)], [(0, 1, 2)], "finite|invalid"),
        ([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)], "must have area"),
        ([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], "triangles|empty"),
        ([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 7)], "index|vertex"),
    ],
)
def test_broken_meshes_are_refused(tmp_path: Path, vertices: list, faces: list, message: str) -> None:
    mesh = write_ply(tmp_path, vertices, faces)
    with pytest.raises(SceneError, match=message):
        load_scene(write(tmp_path, sensor(), mesh, LIGHT))


@pytest.mark.parametrize("source", ["gone.xml", "notes.txt", "builtin:castle", ""])
def test_unknown_sources_are_refused(source: str) -> None:
    with pytest.raises(SceneError, match="must"):
        load_scene(source)


def test_nested_filenames_of_spectra_count(tmp_path: Path) -> None:
    (tmp_path / "grey.spd").write_text("400 0.5\n700 0.5\n")
    bsdf = '<bsdf type="diffuse"><spectrum name="reflectance" filename="grey.spd"/></bsdf>'
    path = write(tmp_path, sensor(), FLOOR.replace("</shape>", bsdf + "</shape>"), LIGHT)
    first = load_scene(path).digest
    (tmp_path / "grey.spd").write_text("400 0.2\n700 0.2\n")
    assert load_scene(path).digest != first
