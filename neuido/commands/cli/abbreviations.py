"""Names on the command line must be whole."""


def refuse_abbreviations() -> None:
    """Let every parser of jsonargparse take whole names of options alone, those of Lightning's commands included."""
    from jsonargparse import ArgumentParser

    ArgumentParser._get_option_tuples = lambda self, option_string: []  # what argparse asks for names that begin so
