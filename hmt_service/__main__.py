"""Entry point of `hmt`: where the package's own errors become a line and an exit code.

References: own.
"""

from __future__ import annotations

from rich.console import Console
from rich.text import Text

from hmt_service.cli.app import app
from hmt_service.errors import (
    BAD_INPUT,
    AccessDenied,
    DaemonFailure,
    DeadlineExceeded,
    HmtError,
    InvalidConfig,
    InvalidLog,
    Unauthenticated,
    Unavailable,
    Unreachable,
)

_NEXT: dict[type[HmtError], str] = {
    AccessDenied: "name the credentials of a role that may: --zenoh-config (README, Security)",
    DaemonFailure: "what the daemon has printed, and `hmt events`, say why",
    DeadlineExceeded: "wait longer (--timeout); `hmt status` tells how far behind the daemon is",
    InvalidConfig: "docs/configuration.md lists every setting with its range",
    InvalidLog: "docs/troubleshooting.md, under logs",
    Unauthenticated: "README, Security: certificates or passwords, or --allow-unauthenticated",
    Unavailable: "`hmt status` tells what a daemon has got, `hmt doctor` whether there is one",
    Unreachable: "without internet, have the file on another server: --mirror URL of its folder",
}
"""What to do after each kind of error; a kind that is not here is told all in its message."""


def next_step(error: HmtError) -> str:
    """Return what to do after an error; empty where its message says all."""
    return next((_NEXT[kind] for kind in type(error).__mro__ if kind in _NEXT), "")


def main() -> None:
    """Run the command line; an `HmtError` becomes a red line, and one that says what to do next.

    Raises:
        SystemExit: Always: with 0 after success, 2 after an `HmtError` or a wrong option.
    """
    try:
        app()
    except HmtError as error:
        one_line = " ".join(str(error).split())
        console = Console(stderr=True)
        console.print(Text(f"error: {one_line}", style="red"), soft_wrap=True)
        if step := next_step(error):
            console.print(Text(f"next: {step}"), soft_wrap=True)
        raise SystemExit(BAD_INPUT) from error


if __name__ == "__main__":
    main()
