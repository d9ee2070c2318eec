"""The one error that a user can mend: raised with a single line that names what was wrong, the value, and the option to change."""


class UserError(ValueError):
    """Bad input. The command line prints the message as one line and exits with status 2."""
