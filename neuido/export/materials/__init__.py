"""Material laws for other programs: cards of constants, TorchScript and C."""
