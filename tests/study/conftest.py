"""A PostgreSQL server for as long as the tests take."""

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def postgres():
    """The URL of an empty database."""
    folders = [*Path("/usr/lib/postgresql").glob("*/bin"), Path("/usr/local/bin"), Path("/usr/bin")]
    binaries = next((path for path in folders if (path / "initdb").exists()), None)
    if binaries is None:
        pytest.skip("PostgreSQL is not installed")
    user, before = os.geteuid(), []
    if user == 0:  # the server refuses to run as root
        user, before = pwd.getpwnam("nobody").pw_uid, ["runuser", "-u", "nobody", "--"]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # TMPDIR may be closed to that user
    home = Path(tempfile.mkdtemp(prefix="dgae_jax-postgres-", dir="/tmp"))
    os.chown(home, user, -1)

    def run(name, *words):
        command = [*before, str(binaries / name), "-D", str(home / "data"), *words]
        subprocess.run(command, cwd=home, check=True, stdout=subprocess.DEVNULL, timeout=120)

    run("initdb", "-A", "trust", "-U", "tuner", "--no-sync")
    options = f"-p {port} -k {home} -c listen_addresses=127.0.0.1 -c fsync=off"
    run("pg_ctl", "-l", str(home / "log"), "-w", "-o", options, "start")
    try:
        yield f"postgresql://tuner@127.0.0.1:{port}/postgres"
    finally:
        run("pg_ctl", "-m", "immediate", "stop")
        shutil.rmtree(home, ignore_errors=True)
