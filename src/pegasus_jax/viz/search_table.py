"""The table of a search as text. Imports no JAX."""

from pegasus_jax.learn.schedule import SearchTable

ACTIONS, CANDIDATES = ("evaluate", "step"), ("current", "fresh", "other", "leader", "start", "coarse")


def text(table: SearchTable, search: int = 0) -> str:
    """The table of one search, from 0, as lines of words and numbers."""
    head = "iteration scenarios action   candidate refine ends  width   step  limit"
    factors = [column[min(search, len(column) - 1)] for column in table[-3:]]
    yes = {False: "no", True: "yes"}
    lines = [
        f"{i:9d} {s:9d} {ACTIONS[a]:8s} {CANDIDATES[c]:9s} {yes[bool(r)]:6s} {yes[bool(e)]:4s}"
        f" {width:6.3f} {size:6.3f} {limit:6.3g}"
        for i, s, a, c, r, e, width, size, limit in zip(*table[:5], table.ends, *factors, strict=True)
    ]
    return "\n".join([head, *lines])
