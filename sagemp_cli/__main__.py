"""``python -m sagemp_cli`` is ``sagemp``."""

from sagemp_cli.cli.main import main

if __name__ == "__main__":
    main()
