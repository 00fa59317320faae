"""Programs for people: the live table, the fault campaign, the bench."""
