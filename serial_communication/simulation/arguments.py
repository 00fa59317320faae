"""What programs without ROS are given: ports, and a file with parameters of the bridge."""
import argparse
from typing import Any, Dict, List

from ..transport.urls import check_url


def url_argument(text: str) -> str:
    """For argparse: a device or URL that pyserial may be able to open."""
    try:
        check_url(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f'{text}: {error}') from None
    return text


def read_parameters(path: str) -> Dict[str, Any]:
    """The parameters in a file, nested as the parameter server holds them; OSError if it cannot be
    read, ValueError with one line of text if it is not YAML or has none."""
    import yaml     # not at the top: without a configuration only pyserial is needed
    try:
        with open(path, encoding='utf-8') as file:
            given = yaml.safe_load(file) or {}
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError('is not YAML: ' + ' '.join(str(error).split())) from None
    if not isinstance(given, dict):
        raise ValueError('is not a table of parameters (NAME: VALUE)')
    return given


def board_parameters(parameters: Any, name: str) -> Dict[str, Any]:
    """The parameters of one board, from all of them; empty if there is no such group."""
    group = parameters.get(name) if isinstance(parameters, dict) else None
    return group if isinstance(group, dict) else {}


def board_packages(parameters: Any) -> List[Any]:
    """The parameter `boards`, import names of packages with boards; empty if it is not a list."""
    packages = parameters.get('boards') if isinstance(parameters, dict) else None
    return packages if isinstance(packages, list) else []
