"""Factories of people and robots with credentials: the shipped Zenoh files, filled in."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import trustme

from hmt_service.client.local import free_endpoint

SHIPPED = Path(__file__).parents[2] / "deploy" / "zenoh"
ROLES = ("viewer", "operator", "robot")
IMPOSTOR = "impostor"
"""Says that it is the operator, with a certificate of an unknown authority or a wrong password."""


class Kind(StrEnum):
    """How the daemon is told who somebody is: a folder of shipped files."""

    CERTIFICATES = "certificates"
    PASSWORDS = "passwords"


def tls_endpoint() -> str:
    """Return a TLS endpoint on loopback that nobody listens on."""
    return free_endpoint().replace("tcp/", "tls/")


@dataclass(frozen=True)
class Credentials:
    """Everybody's certificate, or password, in a folder that stands for `/etc/hmt`."""

    folder: Path
    kind: Kind

    def __post_init__(self) -> None:
        (self.folder / "tls").mkdir(parents=True)
        (self.folder / "zenoh").mkdir()
        authority = trustme.CA()
        authority.cert_pem.write_to_path(self.folder / "tls" / "ca.pem")
        self._issue(authority, "daemon", "localhost", "127.0.0.1")
        for name in (*ROLES, "stranger"):
            self._issue(authority, name, name)
        self._issue(trustme.CA(), IMPOSTOR, "operator", common_name="operator")
        users = "".join(f"{name}:password of {name}\n" for name in (*ROLES, "stranger"))
        (self.folder / "zenoh" / "users.txt").write_text(users)

    def config(self, name: str, *, of: str | None = None) -> Path:
        """Return the file of Zenoh settings of somebody.

        Args:
            name: Whose certificate or password it has.
            of: Whose shipped file it is; the same name's if not given.
        """
        shipped = SHIPPED / self.kind / f"{of or name}.json5"
        text = shipped.read_text().replace("/etc/hmt/", f"{self.folder}/")
        if of is not None:
            text = text.replace(f"/{of}.", f"/{name}.")
        if of is not None and name != IMPOSTOR:
            text = text.replace(f'user: "{of}"', f'user: "{name}"')
        text = text.replace("change me", f"password of {name}")
        return self._written(f"{name}-{of or name}", text)

    def config_without(self, setting: str) -> Path:
        """Return the operator's file without the lines of one setting."""
        lines = self.config("operator").read_text().splitlines()
        kept = "\n".join(line for line in lines if setting not in line)
        return self._written(f"without-{setting}", kept)

    def _written(self, name: str, text: str) -> Path:
        path = self.folder / "zenoh" / f"{name}.json5"
        path.write_text(text)
        return path

    def _issue(
        self, authority: trustme.CA, name: str, *hosts: str, common_name: str | None = None
    ) -> None:
        issued = authority.issue_cert(*hosts, common_name=common_name or name)
        issued.private_key_pem.write_to_path(self.folder / "tls" / f"{name}.key")
        chain = b"".join(blob.bytes() for blob in issued.cert_chain_pems)
        (self.folder / "tls" / f"{name}.pem").write_bytes(chain)
