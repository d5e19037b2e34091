"""How fast: search steps, parts of a trial, first results, many seeds and devices."""
