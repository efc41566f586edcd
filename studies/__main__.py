"""Entry point of `scripts/bench` in a checkout: `python -m studies`."""

from __future__ import annotations


def remedy(missing: ModuleNotFoundError) -> str:
    """Returns instructions for installing a missing package. Studies need all test dependencies."""
    return f"this command requires {missing.name}, which is not installed; run in the checkout: scripts/setup dev"


if __name__ == "__main__":
    try:
        from client.cli.main import run
        from studies.commands import app
    except ModuleNotFoundError as error:
        raise SystemExit(f"scripts/bench: {remedy(error)}") from None
    run(app, "scripts/bench", remedy)
