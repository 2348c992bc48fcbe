"""``python -m pfem_petsc``, and the command ``pfem-petsc``."""

from __future__ import annotations

import os
import sys


def run() -> int:
    """Run the program and return its exit status."""
    from .signals import watch_early

    watch_early()  # before the imports, which take half a second

    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # it would look for them in all installed packages

    from .signals import leave_at_exit

    leaving = leave_at_exit()  # before the imports, so that what they do at exit is done before

    from .cli.main import main

    return leaving.ends_with(main())


if __name__ == "__main__":
    sys.exit(run())
