"""What a diagnosis leaves behind: its answer, its page, and what to measure next."""
