"""Made experiments with bodies whose clamps move and measure a force."""
