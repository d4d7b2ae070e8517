"""The benchmarks by name, and what the runner prints and records."""

import re
from pathlib import Path

import pytest
import run
from registry import REGISTRY

ROOT = Path(__file__).parents[2]


def test_every_benchmark_has_a_line_in_the_list(capsys):
    run.main(["--list"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(REGISTRY)
    assert all(len(line.split()) > 3 for line in lines)
    sources = (file.read_text() for file in (ROOT / "benchmarks").glob("*.py"))
    registered = re.findall(r'@benchmark\(\s*"(\w+)"', "\n".join(sources))
    assert sorted(registered) == sorted(REGISTRY)


def test_an_unknown_benchmark_and_missing_data_are_clear_errors(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        run.main(["no_such_benchmark"])
    assert ended.value.code == 2
    assert "invalid choice: 'no_such_benchmark'" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        run.main(["real", str(tmp_path)])
    assert str(ended.value).startswith(f"error: {tmp_path}: expected a folder with")
