"""Claims about files: read as text or refused with a reason, written whole or not at all, as strict JSON and CSV."""

from __future__ import annotations

import csv
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpipic.files import Unreadable, json_object, read_text, replacing, to_json, write_csv, write_json, write_text


@dataclass
class Item:
    step: int
    share: float | None


def test_a_text_is_read_without_the_mark_before_it(tmp_path: Path) -> None:
    path = tmp_path / "text"
    path.write_bytes("\ufeffρ = 1\r\n".encode())
    assert read_text(path) == "ρ = 1\r\n"


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("none", "cannot be read: No such file or directory"),
        (".", "cannot be read: Is a directory"),
        ("a\0b", "cannot be read: embedded null byte"),
        ("latin", "not a text file in UTF-8 (byte 2)"),
    ],
)
def test_what_is_no_text_is_refused_with_the_reason(tmp_path: Path, name: str, reason: str) -> None:
    (tmp_path / "latin").write_bytes("na\xefve".encode("latin-1"))
    with pytest.raises(Unreadable) as caught:
        read_text(tmp_path / name)
    assert str(caught.value) == reason


def test_a_text_keeps_its_line_ends(tmp_path: Path) -> None:
    write_text(tmp_path / "text", "a\r\nρ\n")
    assert (tmp_path / "text").read_bytes() == "a\r\nρ\n".encode()


def test_json_is_strict_and_unpacks_records_numpy_and_paths(tmp_path: Path) -> None:
    value = {
        "nan": float("nan"), "list": (1.5, np.inf, np.float64("-inf")), "array": np.array([[1.0], [np.nan]]),
        "n": np.int64(3), "flag": np.bool_(True), "items": [Item(7, None)], "path": Path("a/b"),
        "nested": {1: {"x": np.float32(0.5)}}, "name": "ρ",
    }  # fmt: skip
    expected = {
        "nan": None, "list": [1.5, None, None], "array": [[1.0], [None]], "n": 3, "flag": True,
        "items": [{"step": 7, "share": None}], "path": "a/b", "nested": {"1": {"x": 0.5}}, "name": "ρ",
    }  # fmt: skip
    write_json(tmp_path / "x.json", value)
    text = (tmp_path / "x.json").read_text("utf-8")
    assert json.loads(text, parse_constant=pytest.fail) == expected and text.endswith("}\n") and "ρ" in text
    assert json.loads(to_json(value)) == expected and "\n" not in to_json(value)


@pytest.mark.parametrize("text", ["", "{", "[1]", "7", b'{"a": 1', b"\xff"])
def test_what_is_no_json_object_is_an_empty_one(text: str | bytes) -> None:
    assert json_object(text) == {} and json_object('{"a": [1, null]}') == json_object(b'{"a": [1, null]}')
    assert json_object('{"a": [1, null]}') == {"a": [1, None]}


def test_csv_reads_back_to_the_same_bits_and_none_is_empty(tmp_path: Path) -> None:
    row = [0.1 + 0.2, np.float64(1 / 3), np.float32(0.5), 5e-324, np.int64(10), None, 'a,\n"b"', True, float("nan")]
    write_csv(tmp_path / "x.csv", [f"c{k}" for k in range(len(row))], iter([row]))
    assert b"\r" not in (tmp_path / "x.csv").read_bytes()
    with (tmp_path / "x.csv").open(newline="", encoding="utf-8") as stream:
        header, cells = csv.reader(stream)
    assert header[:2] == ["c0", "c1"] and [float(cell) for cell in cells[:4]] == row[:4]
    assert cells[4:] == ["10", "", 'a,\n"b"', "True", "nan"]


def test_a_write_that_fails_keeps_the_old_file_and_leaves_no_other(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    write_json(path, {"steps": 1})
    with pytest.raises(TypeError):
        write_json(path, {"steps": object()})
    with pytest.raises(RuntimeError), replacing(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert [found.name for found in tmp_path.iterdir()] == ["x.json"]
    assert json.loads(path.read_text()) == {"steps": 1}


def test_a_file_is_on_disk_before_it_gets_its_name(tmp_path: Path, monkeypatch: Any) -> None:
    calls: list[str] = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda descriptor: (calls.append("fsync"), fsync(descriptor)))
    monkeypatch.setattr(os, "replace", lambda a, b: (calls.append(Path(b).name), replace(a, b)))
    write_csv(tmp_path / "x.csv", ["a"], [])
    assert calls == ["fsync", "x.csv"]
