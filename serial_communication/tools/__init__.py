"""Programs for people: the demo's table, the monitor, the web page, `wire`, `ports`, `header`."""
