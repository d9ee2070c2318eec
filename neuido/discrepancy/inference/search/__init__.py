"""The search for missing effects: fit candidates, compare them, and add effects singly or in pairs until the answer is final."""
