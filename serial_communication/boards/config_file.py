"""A file with parameters of the bridge, for programs that need no ROS."""
from typing import Any, Dict


def read_parameters(path: str) -> Dict[str, Any]:
    """The parameters in a file, nested as the parameter server holds them.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no YAML, or has no parameters; the text is one line for a person.
    """
    try:
        import yaml     # here alone: boards without a configuration need pyserial and no more
    except ImportError:
        raise ValueError('reading it needs PyYAML (python3-yaml)') from None
    try:
        with open(path, encoding='utf-8') as file:
            given = yaml.safe_load(file) or {}
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError('is no YAML: ' + ' '.join(str(error).split())) from None
    if not isinstance(given, dict):
        raise ValueError('has no parameters by name')
    return given


def of_board(parameters: Any, name: str) -> Dict[str, Any]:
    """A board's own ones of nested parameters; none where there is no such group."""
    group = parameters.get(name) if isinstance(parameters, dict) else None
    return group if isinstance(group, dict) else {}
