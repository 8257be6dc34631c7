"""Speed, as figures measured side by side in one run: ``make bench``."""
