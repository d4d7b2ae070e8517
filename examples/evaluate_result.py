"""Evaluate 3D joints against the truth: errors of joints, people found, identities.

    python examples/evaluate_result.py joints.npz match/reference/joints.npz 25

Both files have `frames`, `person_ids` and `joints` (frames, persons, 17, 3) in metres, as
`worldpose export --format joints` writes them. docs/reference/metrics.md defines every metric.
"""

import sys

import worldpose as wp


def main() -> None:
    """Print the metrics of the whole file and of each true person."""
    prediction, reference, fps = sys.argv[1:]
    metrics, people = wp.evaluate_joints(
        wp.read_joints(prediction), wp.read_joints(reference), fps=float(fps)
    )
    print(metrics.model_dump_json(indent=2, exclude_none=True))
    for person in people:
        print(person)


if __name__ == "__main__":
    main()
