"""Making and renewing certificates."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest
from cryptography import x509

from deploy.certificates import main
from proto.permissions import Holder
from proto.security import common_name, read_certificate


def contents(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def hosts(folder: Path) -> set[str]:
    found = read_certificate(folder / "hub.crt").extensions
    names = found.get_extension_for_class(x509.SubjectAlternativeName).value
    return {str(name.value) for name in names}


def test_each_role_gets_a_certificate_and_nobody_else_can_read_the_keys(tmp_path: Path) -> None:
    folder = tmp_path / "made"
    assert main(["--out", str(folder), "--hosts", "hub.example", "10.0.0.1"]) == 0
    names = {"authority", *Holder}
    assert set(contents(folder)) == {f"{name}.{end}" for name in names for end in ("crt", "key")}
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert {stat.S_IMODE(key.stat().st_mode) for key in folder.glob("*.key")} == {0o600}
    for holder in Holder:
        assert common_name(read_certificate(folder / f"{holder}.crt")) == holder
    assert hosts(folder) == {"localhost", "127.0.0.1", "::1", "hub.example", "10.0.0.1"}


def test_what_is_there_stays_until_it_is_renewed(tmp_path: Path) -> None:
    words = ["--out", str(tmp_path)]
    main([*words, "--hosts", "hub.example"])
    first = contents(tmp_path)
    main([*words, "--actors", "vm1"])
    more = contents(tmp_path)
    assert more.keys() - first.keys() == {"actor-vm1.crt", "actor-vm1.key"}
    assert more | first == more
    main([*words, "--renew", "--days", "10"])
    renewed = contents(tmp_path)
    assert {name for name in more if more[name] == renewed[name]} == {
        "authority.crt",
        "authority.key",
    }
    assert "hub.example" in hosts(tmp_path)
    main([*words, "--hosts", "other.example"])
    changed = contents(tmp_path)
    assert {name for name in renewed if renewed[name] != changed[name]} == {"hub.crt", "hub.key"}
    assert hosts(tmp_path) == {"localhost", "127.0.0.1", "::1", "other.example"}


def test_without_the_authoritys_key_nothing_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["--out", str(tmp_path)])
    (tmp_path / "authority.key").unlink()
    before = contents(tmp_path)
    assert main(["--out", str(tmp_path), "--renew"]) == 2
    assert "certificates are made where the authority is kept" in capsys.readouterr().err
    assert contents(tmp_path) == before


@pytest.mark.parametrize("words", [["--hosts", "a b"], ["--actors", "../x"], ["--days", "0"]])
def test_bad_input_makes_nothing(words: list[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--out", str(tmp_path / "made"), *words])
    assert ended.value.code == 2
    assert not (tmp_path / "made").exists()
