"""`python -m neuido` is the `neuido` command."""

from neuido.commands.main import main

if __name__ == "__main__":
    main()
