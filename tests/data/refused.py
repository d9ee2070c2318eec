"""What a reader must do with a file that is wrong in one place."""

from collections.abc import Callable
from pathlib import Path

import pytest

from neuido.errors import UserError


def assert_refused(read: Callable[[Path], object], file: Path, old: str, new: str, message: str) -> None:
    """With its first `old` turned to `new`, the file makes `read` raise one line that names it and matches `message`."""
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(UserError, match=message) as caught:
        read(file)
    assert "\n" not in str(caught.value) and file.name in str(caught.value)
