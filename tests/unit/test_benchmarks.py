"""The benchmarks by name, and what the runner prints and records."""

import json
import re
from pathlib import Path

import pytest
import run
from registry import REGISTRY, Table, as_data, format_table

ROOT = Path(__file__).parents[2]


def test_every_benchmark_has_a_line_in_the_list(capsys):
    run.main(["--list"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(REGISTRY)
    assert all(len(line.split()) > 3 for line in lines)
    sources = (file.read_text() for file in (ROOT / "benchmarks").glob("*.py"))
    registered = re.findall(r'@benchmark\(\s*"(\w+)"', "\n".join(sources))
    assert sorted(registered) == sorted(REGISTRY)


def test_a_benchmark_prints_its_tables_and_records_them_with_the_machine(tmp_path, capsys):
    file = tmp_path / "data" / "speed.json"
    words = ["camera_projection", "--points", "100", "--rounds", "1", "--json", str(file)]
    run.main(words)
    table = json.loads(file.read_text())["tables"]["project"]
    assert table["columns"][:3] == ["side", "time [ms]", "times ours"]
    assert [row[0] for row in table["rows"]] == ["ours", "projectPoints"]
    assert table["rows"][0][2] == 1.0
    assert "| ours |" in capsys.readouterr().out
    found = json.loads(file.read_text())
    assert found["command"].startswith("python benchmarks/run.py camera_projection --points 100")
    assert found["machine"]["cores"] >= 1
    assert set(found["versions"]) >= {"python", "numpy", "worldpose"}


def test_an_unknown_benchmark_and_missing_data_are_clear_errors(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        run.main(["no_such_benchmark"])
    assert ended.value.code == 2
    assert "invalid choice: 'no_such_benchmark'" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        run.main(["real", str(tmp_path)])
    assert str(ended.value).startswith(f"error: {tmp_path}: expected a folder with")


def test_missing_values_are_dashes_on_the_screen_and_null_in_the_data():
    table = Table("title", ["a", "b"], [["x", float("nan")], ["y", 1.23456]], "mm")
    assert format_table(table).splitlines() == [
        *("title [mm]", "", "| a | b |", "| --- | --- |", "| x | - |", "| y | 1.235 |"),
    ]
    assert as_data({"rows": table.rows}) == {"rows": [["x", None], ["y", 1.23456]]}
