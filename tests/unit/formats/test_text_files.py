import pytest

from worldpose.errors import InputError
from worldpose.formats import files
from worldpose.formats.files import read_json, read_toml, read_yaml


@pytest.fixture
def refused(tmp_path):
    def check(read, content, words):
        path = tmp_path / "file"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(InputError) as caught:
            read(path)
        assert words in str(caught.value)
        assert str(path) in caught.value.where

    return check


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("a: &x [1, 2]\nb: *x\n", "alias"),
        ("fps: 25\nfps: 30\n", "'fps' is given twice"),
        ("1: a\n'1': b\n", "'1' is given twice"),
        ("a: " + "[" * 100, "more than 32 levels"),
        ("? [a]\n: 1\n", "unhashable"),
        ("a: 1\n--- \nb: 2\n", "but found another document"),
        ("!!python/object/apply:os.system [x]", "python/object"),
        ("a: b: c\n", "line 1, column 5"),
        *((f"fps: {text}\n", "") for text in ('!!int ""', "!!bool maybe", "!!timestamp soon")),
        ("a: " + "9" * 5000, "digits"),
        (b"a: \xff\n", "UTF-8"),
        (b"a: \x00\n", "YAML"),
    ],
)
def test_hostile_or_broken_yaml_is_refused(refused, content, words):
    refused(read_yaml, content, words)


def test_a_flood_of_entries_is_refused_before_it_is_built(refused, monkeypatch):
    monkeypatch.setattr(files, "EVENTS", 1000)
    refused(read_yaml, "- a\n" * 1001, "more than 1000 entries")


@pytest.mark.parametrize("read", [read_yaml, read_json, read_toml])
def test_a_file_beyond_the_limit_is_refused_unread(refused, read):
    refused(read, b"#" * (files.SETTINGS_BYTES + 1), "2097153 bytes")


@pytest.mark.parametrize("content", ["[" * 100_000, '{"a": ', "", "[" + "9" * 5000 + "]"])
def test_broken_json_is_refused(refused, content):
    refused(read_json, content, "expected JSON")


def test_a_key_that_would_take_hours_is_refused(refused):
    refused(read_toml, "a" + ".a" * 300_000 + " = 1", "lines of at most 4096")


@pytest.mark.parametrize("content", ["a = ", "a = 1\na = 2", "a = " + "[" * 4000, "x = 2024-99-99"])
def test_broken_toml_is_refused(refused, content):
    refused(read_toml, content, "expected TOML")
