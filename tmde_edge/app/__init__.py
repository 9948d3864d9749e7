"""The verbs: live, dry-run, measure, replay, simulate and their wiring."""
