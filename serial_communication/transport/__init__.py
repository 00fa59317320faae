"""Serial ports, and timing: for links, simulated boards and tools."""
