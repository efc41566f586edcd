"""Entry point of `python -m client.cli`, the `scas4d` command."""

from client.cli.main import main

if __name__ == "__main__":
    main()
