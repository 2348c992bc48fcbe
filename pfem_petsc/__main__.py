"""``python -m pfem_petsc``."""

if __name__ == "__main__":
    from .signals import watch_early

    watch_early()  # before the imports, which take half a second

    import sys

    from .leaving import leave_at_exit

    leaving = leave_at_exit()  # before the imports, so that what they do at exit is done before

    from .cli.main import main

    sys.exit(leaving.ends_with(main()))
