"""What a mistyped word on the command line may have meant."""

import difflib
from collections.abc import Iterable


def suggest(word: str, known: Iterable[str]) -> str:
    """Return `, did you mean '…'?` for the known word closest to one that is not known, or nothing where none is close."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f", did you mean '{close[0]}'?" if close else ""


def refuse_abbreviations() -> None:
    """Let every parser of jsonargparse take whole names of options alone, those of Lightning's commands included."""
    from jsonargparse import ArgumentParser

    ArgumentParser._get_option_tuples = lambda self, option_string: []  # what argparse asks for names that begin so
