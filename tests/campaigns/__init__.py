"""Campaigns: kills, damages, bad commands, stops of a robot. docs/reliability.md says what each measures."""
