"""The command line as a user meets it, run in this process."""

import pytest

from neuido.commands.main import main


def run(capsys, *args) -> tuple[int, str, str]:
    """Status, stdout and stderr of `neuido` with these arguments."""
    with pytest.raises(SystemExit) as stop:
        main([str(a) for a in args])
    out, err = capsys.readouterr()
    return stop.value.code, out, err
