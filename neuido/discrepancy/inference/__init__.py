"""From a residual to a name: fits, floors, rounds and what is said of them."""
