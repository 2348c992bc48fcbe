"""``python -m pfem_petsc``."""

if __name__ == "__main__":
    from .signals import watch_early

    watch_early()  # before the imports, which take a second

    import sys

    from .cli.main import main

    sys.exit(main())
