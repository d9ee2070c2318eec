"""What a balance came to, kept with the result of its test; `benchmarks/balances.py` makes the table of them."""

import json
from collections.abc import Callable


def note(record_property: Callable, what: str, case: str, found: float, exact: float) -> None:
    """Keep a measured value and the exact one.

    Args:
        record_property: pytest's fixture.
        what: The balance or closed form.
        case: Of which bodies, at which grid.
        found: The measured value.
        exact: The exact one; of a quantity that must not change, zero.
    """
    record_property("balance", json.dumps([what, case, float(found), float(exact)]))
