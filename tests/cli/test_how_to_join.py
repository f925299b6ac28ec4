"""The command line of an actor that `daedalus learner` logs."""

from pathlib import Path

from building import run_spec
from certificates import unchecked

from daedalus.cli.commands.certs import certs
from daedalus.launch.learner_process import how_to_join


def test_the_command_names_an_address_of_the_certificate(tmp_path: Path) -> None:
    assert certs(["init", str(tmp_path / "certs"), "--host", "gpu-box.lan", "--host", "192.0.2.7"]) == 0
    credentials = unchecked(tmp_path / "certs" / "learner", "learner", "")
    line = how_to_join(["tls/0.0.0.0:7447"], credentials, run_spec())
    expected = "daedalus actor --connect tls/gpu-box.lan:7447 --tls DIR (or at tls/192.0.2.7:7447"
    assert line.startswith(expected)


def test_without_tls_an_address_of_the_command_line_stays_as_it_is() -> None:
    assert how_to_join(["tcp/127.0.0.1:7447"], None, run_spec()) == "daedalus actor --connect tcp/127.0.0.1:7447"
