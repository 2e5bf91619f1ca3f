"""The command line of meniscus: ``python -m pymeniscus convert frames --out surfaces``."""

import os
import sys

from . import _native


def main() -> None:
    """Run the command line with the arguments of this process, and exit with its status."""
    status = _native.run_command(["meniscus", *sys.argv[1:]])
    # Skip Python's own shutdown: the command has flushed its output, and nothing else needs it.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


if __name__ == "__main__":
    main()
