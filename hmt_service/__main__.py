"""Entry point of `hmt`: where the package's own errors become a line and an exit code.

References: own.
"""

from __future__ import annotations

from rich.console import Console
from rich.text import Text

from hmt_service.cli.app import app
from hmt_service.errors import BAD_INPUT, HmtError


def main() -> None:
    """Run the command line; an `HmtError` becomes one red line on standard error.

    Raises:
        SystemExit: Always: with 0 after success, 2 after an `HmtError` or a wrong option.
    """
    try:
        app()
    except HmtError as error:
        one_line = " ".join(str(error).split())
        Console(stderr=True).print(Text(f"error: {one_line}", style="red"), soft_wrap=True)
        raise SystemExit(BAD_INPUT) from error


if __name__ == "__main__":
    main()
