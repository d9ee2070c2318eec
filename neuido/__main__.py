"""`python -m neuido` is the `neuido` command."""

from neuido.cli import main

if __name__ == "__main__":
    main()
