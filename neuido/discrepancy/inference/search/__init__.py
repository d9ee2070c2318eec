"""From a residual to a name: effects fitted side by side, weighed, and added one by one or in pairs until the answer stands."""
