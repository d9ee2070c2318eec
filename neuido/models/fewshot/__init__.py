"""Few-shot adaptation: methods that fit one scene."""
