"""What is installed has the pages to which log lines and --help lead, and doc/install.md names the
packages that scripts/demo installs."""
import os
import re
import subprocess

import pytest
from pages import ROOT
from test_links import links

BUILD = ROOT / 'build'


@pytest.fixture(scope='module', name='share')
def fixture_share(tmp_path_factory):
    """The folder of the installed package."""
    root = tmp_path_factory.mktemp('install')
    # Some of catkin's files go to the prefix of the configuration, whatever --prefix says.
    done = subprocess.run(['cmake', '--install', str(BUILD), '--prefix', '/opt'],
                          env={**os.environ, 'DESTDIR': str(root)},
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    assert done.returncode == 0, done.stdout
    return root / 'opt' / 'share' / 'serial_communication'


def test_pages_named_in_the_code_are_installed(share):
    named = {name for path in (*(ROOT / 'serial_communication').rglob('*.py'),
                               *(ROOT / 'config').iterdir(), *(ROOT / 'srv').iterdir())
             for name in re.findall(r'\b(?:doc|firmware)/\w+\.md', path.read_text())}
    assert len(named) > 2
    assert sorted(name for name in named if not (share / name).exists()) == []


def test_links_of_installed_pages_lead_to_installed_files(share):
    for page in (share / 'README.md', share / 'firmware' / 'README.md', *(share / 'doc').iterdir()):
        if page.suffix == '.md':
            targets = [(page.parent / link.partition('#')[0]).resolve() for link in links(page)]
            assert [target for target in targets
                    if not target.exists() and share / 'test' not in target.parents] == [], page


def test_no_build_of_the_firmware_is_installed(share):
    assert not (share / 'firmware' / 'build').exists()


def test_the_page_names_the_packages_of_debian():
    table = (ROOT / 'scripts' / 'environment.bash').read_text()
    wanted = [name.partition('=')[0]
              for row in re.findall(r'^(?:run|panel) +(.*)$', table, re.MULTILINE)
              for name in row.split()]
    page = (ROOT / 'doc' / 'install.md').read_text()
    assert re.search(r'^sudo apt install --no-install-recommends (.*)$', page, re.MULTILINE).group(1).split() == wanted
