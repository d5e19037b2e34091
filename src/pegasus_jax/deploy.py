"""Where `pegasus_jax.controller` was in earlier versions: scripts on robots still import it from here."""

from pegasus_jax.runs.controller import controller as controller
