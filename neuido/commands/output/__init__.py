"""Commands that turn results into what other programs and people look at."""
