"""The paper's experiments: what each compares (a TOML file a figure), its studies, its claims and what they came to."""
