"""`scripts/bench`, from a checkout: `python -m studies`."""

from client.cli.main import run
from studies.commands import app

run(app)
