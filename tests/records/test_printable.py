"""Printing of text from input files: control characters and markup are escaped."""

import io
import json
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import given, strategies as st
from mcap.writer import Writer

from pdhef_logtool import PdhefError, inspect_log
from pdhef_logtool.cli import console
from pdhef_logtool.cli.inspecting import render_inspection
from pdhef_logtool.records.printable import all_printable, listed, printable, utf8
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.storage.documents import jsonable
from tests.command_line import printed

_ANY = st.text(st.characters(exclude_categories=()), max_size=60)  # surrogates, too
_HOSTILE = "\x1b[31m\nwarning: forged\r\x9b2J\u202e\u2066\u200f\x00\x7f\u2028\udcff [red][/]"


@given(_ANY, st.integers(10, 60))
def test_what_is_shown_is_one_printable_line_of_limited_length(text, most):
    line = printable(text, most)
    assert line.isprintable()
    assert len(line) <= most
    line.encode()
    if text.isprintable() and len(text) <= most:
        assert line == text


def test_a_text_of_the_largest_length_is_whole_and_names_beyond_the_most_are_counted():
    assert printable("abcde", 5) == "abcde"
    assert listed("abcdefgh") == "a, b, c, d, e and 3 more"
    assert listed("abc", 2, count=7) == "a, b and 5 more"


@given(_ANY)
def test_every_document_of_ours_is_utf8(text):
    utf8(text).encode()
    json.dumps(jsonable({text: [text, Path("a") / text.replace("\0", "")]}), ensure_ascii=False).encode()


@given(_ANY, _ANY)
def test_an_error_is_one_line(got, where):
    assert str(PdhefError(expected="x", got=got, where=where)).isprintable()


def test_records_are_shown_whole():
    @dataclass(frozen=True, slots=True)
    class Record:
        losses: tuple[Loss, ...]
        facts: dict[str, object]
        path: Path

    seen = all_printable(Record((Loss("a", _HOSTILE, "\n"),), {"\x1b": [_HOSTILE, 1, None]}, Path("a\nb")))
    assert seen.losses[0].what == printable(_HOSTILE)
    assert seen.losses[0].where == "\\n"
    assert seen.facts == {"\\x1b": [printable(_HOSTILE), 1, None]}
    assert seen.path == Path("a\\nb")


def test_the_console_obeys_nothing_and_forges_no_line(capsys):
    console.warn(f"topic {_HOSTILE}")
    console.print_json({"topic": _HOSTILE})
    console.show({"topic": _HOSTILE}, "facts")
    out, err = capsys.readouterr()
    assert err.count("\n") == 1
    assert (out + err).replace("\n", "").isprintable()
    document, _ = json.JSONDecoder().raw_decode(out)
    assert document["topic"] == utf8(_HOSTILE)  # a program still has the name


@pytest.mark.parametrize("as_json", [False, True])
def test_an_inspection_of_hostile_names_is_plain(tmp_path, capsys, monkeypatch, as_json):
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start(profile="", library="test")
    topic = _HOSTILE.replace("\udcff", "")
    schema = writer.register_schema(topic, "jsonschema", b'{"properties": {"x": {"type": "number"}}}')
    writer.add_message(writer.register_channel(topic, "json", schema), 5, b'{"x": 1}', 5)
    writer.finish()
    # A file name that is not valid UTF-8 and contains color markup.
    path = tmp_path / "a\n\x1b[31m[/red]\udcff.mcap"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(stream.getvalue())
    monkeypatch.setattr(console, "as_json", as_json)
    console.show(inspect_log(path), render_inspection)
    out = capsys.readouterr().out
    assert out.replace("\n", "").isprintable()
    assert "warning: forged" not in out.splitlines()
    if as_json:
        assert json.loads(out)["topics"][0]["name"] == topic
    else:
        assert "[red][/]" in out.replace("\n", "").replace(" ", "")


@pytest.mark.parametrize("name", ["a[red]b", "[/]", "[bold", "x\\", "\\[x]", ":smile:", "==x", "|x", "]"])
def test_a_name_is_no_markup_of_the_terminals_templates(name):
    assert printed("facts", {name: name}) == f"{name}: {name}\n"
    field = {"path": name, "type": name, "minimum": 1.0, "mean": 1.0, "maximum": 1.0}
    topics = [{"name": name, "type": name, "fields": of, "reason": "", "rate_hz": 1.0} for of in ([], [field])]
    lines = printed("fields", {"path": name, "whole": True, "seconds": 1.0, "topics": topics}).splitlines()
    assert [lines[0], lines[2]] == [name, f"{name} ({name}): "]
    assert lines[3].rstrip() == f"{name} ({name}), 1 Hz" and lines[-2].split() == [name, name, "1", "1", "1"]
