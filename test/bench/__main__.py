from .arguments import parse

options = parse()
# After the arguments are known to be right: `--help` needs nothing of what this imports.
from .cli import main  # noqa: E402

raise SystemExit(main(options))
