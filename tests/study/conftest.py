"""A PostgreSQL server of our own, for as long as the tests take."""

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from pathlib import Path

import pytest


def _binaries():
    found = [
        *sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True),
        Path("/usr/local/bin"),
        Path("/usr/bin"),
    ]
    return next(
        (path for path in found if (path / "initdb").exists() and (path / "pg_ctl").exists()), None
    )


def _unprivileged():
    """The server refuses to run as root: a user that is not, and the words before a command that make it his."""
    if os.geteuid() != 0:
        return os.geteuid(), []
    names = {user.pw_name for user in pwd.getpwall()}
    name = next((name for name in ("postgres", "nobody") if name in names), None)
    if name is None or shutil.which("runuser") is None:
        pytest.skip("PostgreSQL does not run as root, and there is no user to run it as")
    return pwd.getpwnam(name).pw_uid, ["runuser", "-u", name, "--"]


@pytest.fixture(scope="session")
def postgres():
    """The URL of an empty database on a server that ends with the tests."""
    binaries = _binaries()
    if binaries is None:
        pytest.skip("there is no PostgreSQL server on this machine: initdb was not found")
    user, before = _unprivileged()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    home = Path(
        tempfile.mkdtemp(prefix="dgae_jax-postgres-", dir="/tmp")
    )  # TMPDIR may be where that user cannot go
    os.chown(home, user, -1)
    data, log = home / "data", home / "log"

    def run(*command):
        words = [*before, str(binaries / command[0]), *map(str, command[1:])]
        subprocess.run(
            words,
            cwd=home,
            check=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.STDOUT,
            timeout=120,
        )

    run("initdb", "-D", data, "-A", "trust", "-U", "tuner", "--no-sync")
    run(
        "pg_ctl",
        "-D",
        data,
        "-l",
        log,
        "-w",
        "-o",
        f"-p {port} -k {home} -c listen_addresses=127.0.0.1 -c fsync=off",
        "start",
    )
    try:
        yield f"postgresql://tuner@127.0.0.1:{port}/postgres"
    finally:
        run("pg_ctl", "-D", data, "-m", "immediate", "stop")
        shutil.rmtree(home, ignore_errors=True)
