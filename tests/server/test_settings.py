"""Settings: where they come from, what they refuse, and that their pages are up to date."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from server.settings import ServerSettings, SettingsError, unknown_names

ROOT = Path(__file__).parents[2]


def test_what_is_given_wins_over_the_environment_and_that_over_the_file(tmp_path):
    file = tmp_path / "scas4d.toml"
    file.write_text('port = 1\nmax_scenes = 2\nqueue_frames = 3\nallowed_hosts = ["a", "b:1"]\n')
    environment = {"SCAS4D_CONFIG": str(file), "SCAS4D_PORT": "4", "SCAS4D_MAX_SCENES": "5", "SCAS4D_MAX_BODY_MB": "6"}
    found = ServerSettings.from_environment(environment, port=7, data=None)
    assert (found.port, found.max_scenes, found.queue_frames, found.max_body_mb) == (7, 5, 3, 6.0)
    assert found.allowed_hosts == ("a", "b:1")
    assert found.data == Path("data")
    assert ServerSettings.from_environment({"SCAS4D_ALLOWED_HOSTS": "c, d:2 ,"}).allowed_hosts == ("c", "d:2")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('tokken = "x"', r"tokken.*token_file"),
        ("max_scenes = ", "not valid TOML"),
        ("max_scenes = 0", "setting max_scenes.*greater than or equal to 1"),
        ('host = "::"', "no token"),
        ('allowed_origins = ["studio.example"]', "allowed_origins.*scheme"),
        ('token_file = "nowhere"', "file nowhere does not exist"),
        ('token = "a-token-of-thirty-two-characters"\ntoken_file = "nowhere"', "both set"),
    ],
)
def test_a_bad_file_is_refused_by_name(tmp_path, text, said):
    file = tmp_path / "scas4d.toml"
    file.write_text(text)
    with pytest.raises(SettingsError, match=f"(?s){said}"):
        ServerSettings.from_environment({"SCAS4D_CONFIG": str(file)})


def test_the_value_is_quoted_unless_it_may_be_a_secret():
    with pytest.raises(SettingsError, match=r"setting port has the invalid value 'abc': .*integer"):
        ServerSettings.from_environment({"SCAS4D_PORT": "abc"})
    with pytest.raises(SettingsError) as refused:
        ServerSettings.from_environment({"SCAS4D_TOKEN": "hush"})
    assert "hush" not in str(refused.value)


def test_a_file_that_is_not_there_is_refused():
    with pytest.raises(SettingsError, match="does not exist"):
        ServerSettings.from_environment({"SCAS4D_CONFIG": "nowhere.toml"})


def test_a_misspelt_variable_is_noticed():
    environment = {"SCAS4D_PORT": "1", "SCAS4D_PROT": "1", "SCAS4D_CONFIG": "x", "SCAS4D_URL": "y", "PATH": "/bin"}
    assert unknown_names(environment) == ["SCAS4D_PROT"]


@pytest.mark.parametrize("name", ServerSettings.model_fields)
def test_every_setting_is_documented(name):
    assert (ServerSettings.model_fields[name].description or "").endswith((".", ";", ")"))


def test_the_pages_are_up_to_date():
    done = subprocess.run(
        [sys.executable, "scripts/settings_pages.py", "--check"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_limit_that_a_remedy_names_is_a_setting():
    named = set()
    for path in (ROOT / "server").rglob("*.py"):
        named |= set(re.findall(r"SCAS4D_([A-Z_]+[A-Z])", path.read_text()))
    assert "MAX_BODY_MB" in named
    assert {name.lower() for name in named} - {"config", "url"} <= set(ServerSettings.model_fields)
