"""python3 -m serial_communication.tools.wire: runs the programs without ROS."""
from .cli import main

raise SystemExit(main())
