# ruff: noqa: E501  # tables are read by the row
"""Scenes in XML and YAML that must be refused."""

import json
import zipfile
from collections.abc import Iterator

from tests.service.bundle_packing import LIGHT, SENSOR, SHAPE, YAML, Hostile, pack, scenes, xml


def bad_xml() -> Iterator[Hostile]:
    dtds = {
        "entity": '<!DOCTYPE scene [<!ENTITY a "b">]>', "file": '<!DOCTYPE scene [<!ENTITY a SYSTEM "file:///etc/passwd">]>',
        "http": '<!DOCTYPE scene SYSTEM "http://localhost/x.dtd">', "empty": "<!DOCTYPE scene>",
        "parameter": '<!DOCTYPE scene [<!ENTITY % p SYSTEM "http://localhost/p"> %p;]>',
        "laughs": '<!DOCTYPE scene [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;"><!ENTITY c "&b;&b;&b;">]>',
    }  # fmt: skip
    for label, dtd in dtds.items():
        yield Hostile(f"dtd-{label}", lambda dtd=dtd: pack({"scene.xml": xml("", head=dtd)}), "document type")
    yield Hostile(
        "dtd-in-other-file", lambda: pack({"scene.xml": xml(""), "b/x.xml": xml("", head=dtds["file"])}), "document"
    )
    yield Hostile("dtd-in-include", lambda: pack({"scene.xml": xml('<include filename="b.xml"/>'),
                                                  "b.xml": xml("", head=dtds["entity"])}), "document type")  # fmt: skip
    broken = {
        "empty": b"", "text": b"hello", "unclosed": b"<scene", "no-end": xml("")[:-3], "two-roots": xml("") * 2,
        "undefined-entity": xml("&nope;"), "utf16": xml("").decode().encode("utf-16"), "duplicate-attribute":
        b'<scene version="3.0.0" version="3.0.0"/>', "bad-utf8": xml("").replace(b"rectangle", b"\xff\xfe"),
        "zero-byte": xml("") + b"\x00", "nul-reference": xml("<!-- --><string name='a' value='&#0;'/>"), "mismatch": b"<a></b>",
        "encoding": b'<?xml version="1.0" encoding="utf-7"?>' + xml(""), "latin": b'<?xml version="1.0" encoding="latin-1"?>' + xml(""),
        "unbound-prefix": xml("<xi:include href='/etc/passwd'/>"),
    }  # fmt: skip
    for label, content in broken.items():
        yield Hostile(f"xml-{label}", lambda content=content: pack({"scene.xml": content}), "XML|UTF-8")
    yield from scenes("format", {
        "xinclude": '<include xmlns="http://www.w3.org/2001/XInclude" filename="a.xml"/>', "unknown-tag": "<script/>",
        "unknown-attribute": '<shape type="cube" href="x"/>', "namespaced": '<shape xmlns:a="a" a:type="cube" type="cube"/>',
        "no-type": "<bsdf/>", "nested-scene": '<scene version="3.0.0"/>', "child-of-property": '<float name="a" value="1"><float name="b" value="1"/></float>',
        "not-a-transform": '<transform name="to_world"><shape type="cube"/></transform>', "bare-matrix": '<matrix value="1"/>',
    }, "tag of|attributes|type|root|hold nothing|one of")  # fmt: skip
    for version in ("", "3", "three", "3.0.0.0", "-1.0.0"):
        yield Hostile(f"version-{version}", lambda version=version: pack({"scene.xml": xml("", version)}), "version")
    for tag, missing in (("shape", SHAPE), ("sensor", SENSOR), ("emitter", LIGHT)):
        yield Hostile(
            f"no-{tag}",
            lambda missing=missing: pack({"scene.xml": xml("").replace(missing.encode(), b"")}),
            f"hold a {tag}",
        )
    deep = "<bsdf type='twosided'>" * 80 + "</bsdf>" * 80
    chain = (
        "".join(f'<bsdf type="twosided" id="b{k}"><ref id="b{k + 1}"/></bsdf>' for k in range(400))
        + '<bsdf type="diffuse" id="b400"/>'
    )
    expand = '<default name="a0" value="xxxxxxxxxxxxxxxx"/>' + "".join(
        f'<default name="a{k + 1}" value="{f"$a{k}" * 16}"/>' for k in range(9)
    )  # fmt: skip
    yield from scenes("exhaust", {"nesting": deep, "reference-chain": chain, "parameters": expand,
                                   "circle": '<bsdf type="twosided" id="a"><ref id="b"/></bsdf><bsdf type="twosided" id="b"><ref id="a"/></bsdf>',
                                   "own-circle": '<bsdf type="twosided" id="a"><ref id="a"/></bsdf>'}, "nest|deep|expand|circle")  # fmt: skip
    yield from scenes("reference", {"unknown": '<ref id="nope"/>', "alias": '<alias id="nope" as="b"/>', "parameter": '<float name="a" value="$nope"/>',
                                     "twice": '<bsdf type="null" id="a"/><bsdf type="null" id="a"/>', "escaped": '<string name="a" value="\\$a"/>',
                                     "parameter-name": '<default name="a b" value="1"/>'}, "refer to|new name|default|id of its own|escaped|letters")  # fmt: skip


def bad_paths() -> Iterator[Hostile]:
    outside = {
        "parent": "../a.png", "deep": "a/../../b", "absolute": "/etc/passwd", "home": "~/x", "url": "http://localhost/a.png",
        "https": "https://localhost/a.png", "file-url": "file:///etc/passwd", "drive": "C:/x.png", "unc": "\\\\host\\x", "empty": "",
        "backslash-parent": "..\\..\\x", "dots": "..", "blank": " ", "data": "data:image/png;base64,AAAA",
    }  # fmt: skip
    forms = {
        "texture": '<texture type="bitmap"><string name="filename" value="{}"/></texture>',
        "obj": '<shape type="obj"><string name="filename" value="{}"/></shape>',
        "spectrum": '<bsdf type="diffuse"><spectrum name="reflectance" filename="{}"/></bsdf>',
        "include": '<include filename="{}"/>', "path": '<path value="{}"/>',
        "default": '<default name="f" value="{}"/><texture type="bitmap"><string name="filename" value="$f"/></texture>',
    }  # fmt: skip
    for kind, form in forms.items():
        bodies = {label: form.format(name) for label, name in outside.items()}
        yield from scenes(f"{kind}-path", bodies, "inside the bundle")
    yield from scenes(
        "missing",
        {kind: form.format("nope.png") for kind, form in forms.items()},
        "file of the bundle|folder of the bundle",
    )
    for label, name in outside.items():
        quoted = json.dumps(name)
        text = f"scene:\n  a: {{type: obj, filename: {quoted}}}\n"
        yield Hostile(f"yaml-path-{label}", lambda text=text: pack({"scene.yaml": text.encode()}), "inside the bundle")
    include = {f"{k}.xml": xml(f'<include filename="{k + 1}.xml"/>') for k in range(20)} | {"20.xml": xml("")}
    yield Hostile(
        "include-depth", lambda: pack({"scene.xml": xml('<include filename="0.xml"/>'), **include}), "included at most"
    )
    yield Hostile(
        "include-itself", lambda: pack({"scene.xml": xml('<include filename="scene.xml"/>')}), "included at most"
    )
    yield from scenes("text", {"material": '<bsdf type="conductor"><string name="material" value="../../../etc/passwd"/></bsdf>',
                                "absolute": '<bsdf type="conductor"><string name="material" value="/etc/passwd"/></bsdf>',
                                "dots": '<bsdf type="conductor"><string name="material" value=".."/></bsdf>',
                                "backslash": '<bsdf type="conductor"><string name="material" value="..\\x"/></bsdf>'}, "look like a path")  # fmt: skip


def bad_plugins() -> Iterator[Hostile]:
    for name in ("../evil", "/tmp/evil", "./evil", "evil.so", "a\\b", "http://x", "..", "C:evil"):
        yield from scenes("plugin-path", {ascii(name): f'<shape type="{name}"/>'}, "name a Mitsuba plugin")
    for name in ("blender", "instance", "shapegroup", "sdfgrid", "linearcurve", "bsplinecurve", "ellipsoids", "specfilm",
                 "stokes", "measured_polarized", "evil", "OBJ", "obj ", "python", "rgb", "spectrum", "ref", "include"):  # fmt: skip
        yield from scenes("plugin", {name: f'<shape type="{name}"/>'}, "allow-list")
        text = f"scene:\n  a: {{type: {name!r}}}\n"
        if name not in ("rgb", "spectrum", "ref"):
            yield Hostile(f"yaml-plugin-{name}", lambda text=text: pack({"scene.yml": text.encode()}), "allow-list")
    yield from scenes(
        "plugin-parameter", {"type": '<default name="t" value="../evil"/><shape type="$t"/>'}, "Mitsuba plugin"
    )
    yield from scenes("crash", {"bitmap": '<texture type="bitmap"/>', "envmap": '<emitter type="envmap"/>', "blend": '<bsdf type="blendbsdf"/>',
                                 "blend-one": '<bsdf type="blendbsdf"><bsdf type="diffuse"/></bsdf>', "obj": '<shape type="obj"/>'}, "filename|two materials")  # fmt: skip


def bad_numbers() -> Iterator[Hostile]:
    for value in ("nan", "inf", "-Infinity", "1e400", "1e39", "0x10", "1_0", "", "one", "1;2", "1" * 500):
        yield from scenes(
            "float", {value[:12]: f'<shape type="sphere"><float name="radius" value="{value}"/></shape>'}, "finite"
        )
    forms = {
        "rgb": '<bsdf type="diffuse"><rgb name="reflectance" value="1 nan 0"/></bsdf>', "point": '<shape type="sphere"><point name="center" x="inf" y="0" z="0"/></shape>',
        "matrix": '<shape type="cube"><transform name="to_world"><matrix value="1 0 0 nan"/></transform></shape>',
        "lookat": '<shape type="cube"><transform name="to_world"><lookat origin="0,0,inf" target="0,0,0"/></transform></shape>',
        "translate": '<shape type="cube"><transform name="to_world"><translate x="1e99"/></transform></shape>',
        "spectrum": '<bsdf type="diffuse"><spectrum name="reflectance" value="400:nan 700:1"/></bsdf>',
    }  # fmt: skip
    yield from scenes("number", forms, "finite")
    yield from scenes("integer", {"float": '<shape type="cube"><integer name="a" value="1.5"/></shape>', "huge": f'<shape type="cube"><integer name="a" value="{"9" * 40}"/></shape>',
                                   "boolean": '<shape type="cube"><boolean name="a" value="maybe"/></shape>'}, "whole|true")  # fmt: skip
    film = '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="{}"/><integer name="height" value="{}"/></film></sensor>'
    for label, width, height in (
        ("wide", 100000, 1),
        ("zero", 0, 8),
        ("negative", -1, 8),
        ("large", 16000, 16000),
        ("huge", 10**15, 10**15),
    ):
        yield from scenes("film", {label: film.format(width, height)}, "pixels")
    for tag, plugin, key, value in (("sampler", "independent", "sample_count", 10**9), ("sampler", "multijitter", "sample_count", 0),
                                    ("sampler", "stratified", "sampleCount", 10**9), ("integrator", "path", "max_depth", 10**9),
                                    ("integrator", "path", "maxDepth", 10**9), ("integrator", "volpath", "max_depth", -2)):  # fmt: skip
        yield from scenes(
            "limit",
            {f"{plugin}-{key}-{value}": f'<{tag} type="{plugin}"><integer name="{key}" value="{value}"/></{tag}>'},
            "samples|max_depth",
        )


def bad_yaml() -> Iterator[Hostile]:
    laughs = "a0: &a0 [x, x, x, x, x, x, x, x]\n" + "".join(
        f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 8)}]\n" for k in range(1, 9)
    )
    merges = "a0: &a0 {k: v}\n" + "".join(
        f"a{k}: &a{k} {{{', '.join(f'b{j}: *a{k - 1}' for j in range(9))}}}\n" for k in range(1, 9)
    )
    texts = {
        "python-tag": "scene: !!python/object/apply:os.system ['true']\n", "python-name": "scene: !!python/name:os.system\n",
        "custom-tag": "scene: !evil 1\n", "alias-bomb": laughs + YAML, "merge-bomb": merges + YAML, "recursive": "scene: &a [*a]\n",
        "recursive-map": "scene: &a {type: scene, b: *a}\n", "undefined-alias": "scene: *nope\n", "nesting": "[" * 3000,
        "deep-flow": "scene: " + "{a: " * 100 + "1" + "}" * 100, "tabs": "scene:\n\t- a\n", "unclosed": "scene: [1, 2\n", "text": "scene\n",
        "list": "- scene\n", "empty-scene": "scene: {}\n", "no-scene": "camera: {}\n", "two-documents": YAML + "---\n" + YAML, "binary": "scene: \x01\n",
        "nan": "scene:\n  a: {type: sphere, radius: .nan}\n", "inf": "scene:\n  a: {type: sphere, radius: -.inf}\n", "long-int": "scene:\n  a: {type: sphere, radius: " + "9" * 5000 + "}\n",
        "big-int": "scene:\n  a: {type: sphere, radius: " + "9" * 320 + "}\n", "no-type": "scene:\n  a: {radius: 1}\n", "key": "scene:\n  1: {type: sphere}\n", "film":
        "scene:\n  s: {type: perspective, film: {type: hdrfilm, width: 99999, height: 2}}\n", "spectrum-file": "scene:\n  a: {type: diffuse, reflectance: {type: spectrum, filename: a.spd}}\n",
        "rgb-path": "scene:\n  a: {type: diffuse, reflectance: {type: rgb, filename: ../x}}\n", "material": "scene:\n  a: {type: conductor, material: ../../x}\n",
        "missing-file": "scene:\n  a: {type: ply, filename: no.ply}\n", "nested-scene": "scene:\n  a: {type: scene}\n", "date-key": "scene:\n  2026-01-01: {type: sphere}\n",
        "spp": "scene:\n  s: {type: independent, sample_count: 1000000000}\n", "depth": "scene:\n  i: {type: path, max_depth: 1000000000}\n", "bad-date": "scene: {a: 2026-99-99}\n",
    }  # fmt: skip
    words = "YAML|values|nest|hold|scene|finite|text|pixels|path|file of|type|samples|max_depth|inside"
    for label, text in texts.items():
        yield Hostile(f"yaml-{label}", lambda text=text: pack({"scene.yaml": text.encode()}), words)
    yield Hostile("yaml-utf16", lambda: pack({"scene.yaml": YAML.encode("utf-16")}), "UTF-8")
    yield Hostile(
        "yaml-large", lambda: pack({"scene.yaml": b"# " + bytes(range(32, 127)) * 12000}, zipfile.ZIP_STORED), "bytes"
    )
