"""Plants that nobody here wrote, learned with the documented command and judged by their own reward (__main__.py)."""
