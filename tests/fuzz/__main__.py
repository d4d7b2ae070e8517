"""Many cases: `python -m tests.fuzz --cases 500 --seed 1 --out fuzz`.

Each case is a line of `cases.jsonl`. Defects are reproduced with `--case 'KIND+KIND:SEED' --keep
FOLDER`.
"""

import argparse
import json
import os
import sys
import tempfile
from collections import Counter
from pathlib import Path

from .cases import case_name, draw_case, parse_case, prepare, run_case
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
    given = parser.parse_args()
    for folder in filter(None, (given.out, given.keep)):
        folder.mkdir(parents=True, exist_ok=True)
    wanted = [draw_case(given.seed, number) for number in range(given.cases)]
    wanted = [parse_case(text) for text in given.case] if given.case else wanted
    answers = []
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    file = given.out / "cases.jsonl"
    with tempfile.TemporaryDirectory(prefix="worldpose-fuzz-") as place, file.open("w") as log:
        template = prepare(Path(place))
        for names, seed in wanted:
            if not any(given.only in f"{name} {KINDS[name].group}" for name in names):
                continue
            name, answer = (
                case_name(names, seed),
                forked(run_case, names, seed, template, given.keep),
            )
            answers.append({"case": name, **answer})
            print(json.dumps(answers[-1]), file=log, flush=True)
            if answer["class"] in DEFECTS or given.case:
                message = answer.get("message", "")[:1500]
                print(f"{answer['class']}: --case '{name}'\n  {message}", flush=True)
    counts = Counter(answer["class"] for answer in answers)
    harmless = [answer["class"] == RIGHT for answer in answers if answer.get("harmless")]
    told = ", ".join(f"{count} {name}" for name, count in counts.most_common())
    print(f"{len(answers)} cases of {len(KINDS)} kinds: {told}", end="; ")
    print(f"harmless right: {sum(harmless)} of {len(harmless)}")
    sys.exit(1 if any(answer["class"] in DEFECTS for answer in answers) else 0)


if __name__ == "__main__":
    main()
