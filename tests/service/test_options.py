"""Values of the command line: what is read, and that what is not is refused with its remedy."""

import stat
from pathlib import Path

import numpy as np
import pytest

from service import options
from service.errors import OptionError
from workers.camera import Camera


@pytest.mark.parametrize(("text", "size"), [("640x360", (640, 360)), ("1X1", (1, 1)), ("016x9", (16, 9))])
def test_parse_size(text: str, size: tuple[int, int]) -> None:
    assert options.parse_size(text) == size


@pytest.mark.parametrize("text", ["", "640", "640x", "x9", "0x5", "-1x5", "1.5x2", "1x2x3", "٣x٣", "9" * 5000 + "x1"])
def test_parse_size_refuses(text: str) -> None:
    with pytest.raises(OptionError, match="--resolution must be WIDTHxHEIGHT"):
        options.parse_size(text, "--resolution")


def test_parse_look_at_reads_origin_target_up() -> None:
    assert options.parse_look_at("1,2,3,4,5,6,7,8,9") == ([1, 2, 3], [4, 5, 6], [7, 8, 9])
    assert options.parse_look_at("-1,0,1e3, 4,5,6") == ([-1, 0, 1000], [4, 5, 6], [0, 1, 0])


@pytest.mark.parametrize("text", ["", "1,2,3", "1,2,3,4,5,6,7", "1,2,3,4,5,nan,0,1,0", "1,2,3,4,5,inf", "a,b,c,d,e,f"])
def test_parse_look_at_refuses(text: str) -> None:
    with pytest.raises(OptionError, match="--look-at must be 9 numbers"):
        options.parse_look_at(text)


def test_look_at_text_gives_the_same_camera_again() -> None:
    camera = Camera.look_at([-1.5, 2.25, 5], [0.5, 0, -3], [0.1, 1, 0], 40.0, 64, 48)
    again = Camera.look_at(*options.parse_look_at(options.look_at_text(camera)), 40.0, 64, 48)
    np.testing.assert_allclose(again.to_world, camera.to_world, atol=1e-5)


def test_parse_overrides_keeps_everything_after_the_first_equals_sign() -> None:
    assert options.parse_overrides(["a.b=1", "c=x=y", " d = "]) == {"a.b": "1", "c": "x=y", "d": ""}


@pytest.mark.parametrize("assignments", [["a"], ["=1"], [" =1"], ["a=1", "a=2"]])
def test_parse_overrides_refuses(assignments: list[str]) -> None:
    with pytest.raises(OptionError, match="--set must"):
        options.parse_overrides(assignments)


def test_check_writable_refuses_folders_that_are_missing_or_meant_as_files(tmp_path: Path) -> None:
    options.check_writable(tmp_path / "result.json", "--json")
    with pytest.raises(OptionError, match="--json must lie in a folder that exists"):
        options.check_writable(tmp_path / "no" / "result.json", "--json")
    with pytest.raises(OptionError, match="--json must name a file"):
        options.check_writable(tmp_path, "--json")


def test_write_file_replaces_whole_files_that_others_may_read(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    options.write_file(path, b"one")
    options.write_file(path, b"two")
    assert path.read_bytes() == b"two" and [p.name for p in path.parent.iterdir()] == ["a.txt"]
    assert stat.S_IMODE(path.stat().st_mode) & stat.S_IRGRP or path.stat().st_mode & 0o777 == 0o600


def test_write_file_leaves_nothing_when_it_fails(tmp_path: Path) -> None:
    target = tmp_path / "folder"
    target.mkdir()
    with pytest.raises(OSError):
        options.write_file(target, b"x")
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]
