"""Ends a process that imports an orchestrator."""

import sys


class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name in {"prefect", "dask", "distributed", "prefect_dask"}:
            sys.stderr.write(f"orchestrator imported: {name}\n")
            sys.stderr.flush()
            raise SystemExit(99)


sys.meta_path.insert(0, Refuse())
