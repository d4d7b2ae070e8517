"""Many cases, resumable, with a report: `python -m tests.fuzz --cases 500 --seed 1 --out fuzz`.

Each case is a line of `cases.jsonl`; the same command resumes a killed run.
Defects are reproduced with `--case 'KIND+KIND:SEED' --keep FOLDER`.
"""

import argparse
import html
import json
import os
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path

from .cases import case_name, draw_case, parse_case, prepare, run_case
from .command_line_cases import run_by_command_line
from .judging import DEFECTS, RIGHT, forked
from .kinds import KINDS


def main():
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("fuzz"))
    parser.add_argument("--case", action="append", help="Only this one; may be repeated.")
    parser.add_argument("--only", default="", help="Only kinds whose group or name has this in it.")
    parser.add_argument("--keep", type=Path, help="Keep the files of cases here.")
    parser.add_argument("--command-line", action="store_true", help="By `worldpose run`.")
    parser.add_argument("--minutes", type=float, help="Begin no case after so long.")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    if given.keep:
        given.keep.mkdir(parents=True, exist_ok=True)
    if given.case:
        wanted = [parse_case(text) for text in given.case]
    else:
        wanted = [draw_case(given.seed, number) for number in range(given.cases)]
    if given.only:
        wanted = [
            (names, seed)
            for names, seed in wanted
            if any(given.only in name or given.only == KINDS[name].group for name in names)
        ]
    answers = run_all(wanted, given)
    write_report(answers, given.out)
    print(summary(answers))
    sys.exit(1 if any(answer["class"] in DEFECTS for answer in answers) else 0)


def run_all(wanted, given):
    """The outcome of every case; those that are in the file already are not run again."""
    file = given.out / "cases.jsonl"
    known = {}
    if file.exists() and not given.case:
        for line in file.read_text().splitlines():
            answer = json.loads(line)
            known[answer["case"]] = answer
    answers, began, done = [], time.monotonic(), 0
    with tempfile.TemporaryDirectory(prefix="worldpose-fuzz-") as place, file.open("a") as log:
        template = Path(place)
        to_run = [each for each in wanted if case_name(*each) not in known]
        if to_run:
            os.environ.setdefault("OMP_NUM_THREADS", "1")
            prepare(template)
        print(f"{len(KINDS)} kinds, {len(to_run)} of {len(wanted)} cases to run", flush=True)
        for names, seed in wanted:
            name = case_name(names, seed)
            if name in known:
                answers.append(known[name])
                continue
            if given.minutes and time.monotonic() - began > 60 * given.minutes:
                break
            if given.command_line:
                answer = run_by_command_line(names, seed, template, given.keep)
            else:
                answer = forked(run_case, names, seed, template, given.keep)
            answer = {"case": name, "kinds": names, **answer}
            log.write(json.dumps(answer) + "\n")
            log.flush()
            answers.append(answer)
            done += 1
            if answer["class"] in DEFECTS or given.case:
                print(
                    f"{answer['class']}: {name}\n  {answer.get('message', '')[:1500]}", flush=True
                )
            if done % 25 == 0:
                spent = time.monotonic() - began
                left = (len(to_run) - done) * spent / done / 60
                print(
                    f"{done}/{len(to_run)}, {spent / done:.2f} s each, {left:.0f} min left",
                    flush=True,
                )
    return answers


def harmless_share(answers):
    """Cases of harmless kinds alone that came out right, and how many there were."""
    harmless = [answer for answer in answers if answer.get("harmless")]
    return sum(answer["class"] == RIGHT for answer in harmless), len(harmless)


def summary(answers):
    """The classes counted."""
    counts = Counter(answer["class"] for answer in answers)
    right, harmless = harmless_share(answers)
    seconds = sum(answer.get("cpu_seconds", 0) for answer in answers)
    return (
        f"{len(answers)} cases of {len(KINDS)} kinds, {seconds / 60:.1f} min of processor: "
        + ", ".join(f"{count} {name}" for name, count in counts.most_common())
        + f"; harmless right: {right} of {harmless}"
    )


def write_report(answers, out):
    """report.txt and report.html: classes by group, and how to reproduce each defect."""
    groups = defaultdict(Counter)
    for answer in answers:
        label = KINDS[answer["kinds"][0]].group if len(answer["kinds"]) == 1 else "combinations"
        groups[label][answer["class"]] += 1
    classes = sorted({answer["class"] for answer in answers})
    rows = [
        [name, sum(counts.values()), *(counts[each] for each in classes)]
        for name, counts in sorted(groups.items())
    ]
    rows.append(["sum", len(answers), *(sum(c[each] for c in groups.values()) for each in classes)])
    wrong = [
        a for a in answers if a["class"] in DEFECTS or (a.get("harmless") and a["class"] != RIGHT)
    ]
    head = ["group", "cases", *classes]
    lines = [summary(answers), "", "\t".join(head)]
    lines += ["\t".join(map(str, row)) for row in rows]
    lines += [f"\n{a['class']}: --case '{a['case']}'\n{a.get('message') or ''}" for a in wrong]
    (out / "report.txt").write_text("\n".join(lines) + "\n")
    cells = "".join(
        "<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) + "</tr>"
        for row in [head, *rows]
    )
    found = "".join(
        f"<h3>{html.escape(a['class'])}: <code>--case '{html.escape(a['case'])}'</code></h3>"
        f"<pre>{html.escape(a.get('message') or '')}</pre>"
        for a in wrong
    )
    (out / "report.html").write_text(
        "<!DOCTYPE html><meta charset=utf-8><title>fuzz</title><style>td{padding:2px 8px}</style>"
        f"<p>{html.escape(summary(answers))}</p><table>{cells}</table>{found}"
    )


if __name__ == "__main__":
    main()
