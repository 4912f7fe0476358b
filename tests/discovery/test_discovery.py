import unicodedata
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from pdhef_logtool.logs.discovery import find_logs, folders_of
from pdhef_logtool.records.errors import UsageError


def _touch(root: Path, *names: str) -> None:
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_folder_is_searched_and_rosbag2_folders_count_once(tmp_path):
    _touch(
        tmp_path, "a.mcap", "day1/b.bag", "day1/bag2/metadata.yaml", "day1/bag2/x_0.mcap", "notes.txt", "c.mcap.zstd"
    )
    found = find_logs([str(tmp_path)])
    assert [(f.path.relative_to(tmp_path).as_posix(), f.stem) for f in found] == [
        ("a.mcap", "a"),
        ("c.mcap.zstd", "c"),
        ("day1/b.bag", "day1__b"),
        ("day1/bag2", "day1__bag2"),
    ]


def test_own_outputs_and_hidden_folders_are_no_input(tmp_path):
    _touch(tmp_path, "a.mcap", "out/run.json", "out/logs/a/annotated.mcap", ".cache/b.mcap")
    assert [f.stem for f in find_logs([str(tmp_path)])] == ["a"]


def test_same_stem_gets_hash_digits_that_depend_on_the_path_only(tmp_path):
    _touch(tmp_path, "x/a.mcap", "x/a.bag", "x/b.mcap")
    stems = {f.path.name: f.stem for f in find_logs([str(tmp_path / "x")])}
    assert stems["b.mcap"] == "b"
    assert stems["a.mcap"] != stems["a.bag"]
    assert all(len(stems[n]) == len("a-") + 8 and stems[n].startswith("a-") for n in ("a.mcap", "a.bag"))
    assert {f.path.name: f.stem for f in find_logs([str(tmp_path / "x" / "*")])} == stems


def test_each_log_once_whatever_names_it(tmp_path):
    _touch(tmp_path, "a.mcap")
    (tmp_path / "link.mcap").symlink_to(tmp_path / "a.mcap")
    assert len(find_logs([str(tmp_path), str(tmp_path / "a.mcap"), str(tmp_path / "*.mcap")])) == 1


def test_named_file_is_taken_whatever_it_is_called_or_whether_it_exists(tmp_path):
    _touch(tmp_path, "drive.dat")
    assert find_logs([str(tmp_path / "drive.dat")])[0].stem == "drive.dat"
    assert find_logs([str(tmp_path / "none.mcap")])[0].path.name == "none.mcap"


@pytest.mark.parametrize("argument", ["empty", "*.mcap"])
def test_nothing_found_is_a_usage_error_that_names_the_argument(tmp_path, argument):
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match=r"empty|mcap"):
        find_logs([str(tmp_path / argument)])


_HOSTILE = ["..mcap", "...mcap", ".mcap", "a\nb.mcap", "a\\b.mcap", "\x1b[31m.mcap", "\udcff.mcap", "x" * 250 + ".mcap"]
_HOSTILE += ["CON.mcap", "com1.x.mcap", "end. .mcap", " .mcap", "ü" * 120 + ".mcap", "a:b.mcap", "\u202e.mcap"]


def _check_stems(root: Path, names: list[str]) -> list[str]:
    stems = [f.stem for f in find_logs([str(root / name) for name in names])]
    for stem in stems:
        assert stem.isprintable()
        assert 0 < len(stem.encode()) <= 100
        assert stem == stem.strip(". ")
        assert not set(stem) & set('<>:"/\\|?*')
        assert (root / stem).parent == root
        assert stem.split(".")[0].upper() not in ("CON", "NUL", "COM1", "LPT9", "AUX", "PRN")
    assert len({unicodedata.normalize("NFC", s).casefold() for s in stems}) == len(stems)
    return stems


@pytest.mark.parametrize("name", _HOSTILE)
def test_any_name_gives_a_folder_name_that_any_system_takes(tmp_path, name):
    _touch(tmp_path, name)
    (stem,) = _check_stems(tmp_path, [name])
    assert stem[-9] == "-"


#: Of the surrogates only those that stand for bytes of a name that is no UTF-8.
_SIGNS = st.characters(exclude_categories=["Cs"], exclude_characters="/\0*?[") | st.sampled_from("\udcff\udc80 ._aA")


@pytest.mark.slow
@given(st.lists(st.text(_SIGNS, min_size=1, max_size=40)))
def test_stems_are_unique_and_portable_whatever_the_names(names):
    logs = sorted({f"{name}.mcap" for name in names if name != "."})
    if logs:
        _check_stems(Path("/nowhere"), logs)


def test_names_that_some_system_takes_for_one_are_told_apart(tmp_path):
    stems = _check_stems(tmp_path, ["A.mcap", "a.mcap", "ä.mcap", "a\u0308.mcap", "b.mcap"])
    assert stems[-1] == "b"
    assert all(stem[1] == "-" or stem[2] == "-" for stem in stems[:-1])
    # A log whose own name is what another one would get keeps it.
    assert _check_stems(tmp_path, ["A.mcap", "a.mcap", f"{stems[0]}.mcap"])[-1] == stems[0]


def test_links_to_a_folder_above_are_followed_once(tmp_path):
    _touch(tmp_path, "day/a.mcap")
    for number in range(12):
        (tmp_path / "day" / f"link{number}").symlink_to(tmp_path)
    assert [f.stem for f in find_logs([str(tmp_path)])] == ["a"]


def test_folders_are_told_below_the_one_that_holds_all_logs(tmp_path):
    _touch(tmp_path, "fleet/golf/monday/a.mcap", "fleet/golf/b.mcap", "fleet/c.mcap")
    found = find_logs([str(tmp_path)])
    assert {f.path.stem: folder for f, folder in zip(found, folders_of(found), strict=True)} == {
        "a": "golf/monday",
        "b": "golf",
        "c": "",
    }
    assert folders_of(find_logs([str(tmp_path / "fleet/golf/b.mcap")])) == [""]
    assert folders_of([]) == []
