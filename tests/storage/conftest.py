"""An S3 server on this machine, over HTTP, with the credentials of the environment."""

import logging
import uuid
from collections.abc import Iterator

import fsspec
import pytest


@pytest.fixture(scope="session")
def s3_endpoint() -> Iterator[str]:
    """Address of a server that runs until the last test; the environment leads clients to it."""
    pytest.importorskip("s3fs", reason="needs lightwell[s3]")
    server_module = pytest.importorskip("moto.moto_server.threaded_moto_server", reason="needs moto[server]")
    server = server_module.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    logging.getLogger("werkzeug").setLevel(logging.WARNING)
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "testing")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "testing")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        patch.setenv("AWS_EC2_METADATA_DISABLED", "true")
        yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture(scope="session")
def s3_bucket(s3_endpoint: str) -> str:
    """Name of a bucket that all tests share; each takes a prefix of its own."""
    name = f"lightwell-{uuid.uuid4().hex[:12]}"
    fsspec.filesystem("s3").mkdir(name)
    return name


@pytest.fixture
def s3_url(s3_bucket: str) -> str:
    """A place for a store where nothing is."""
    return f"s3://{s3_bucket}/{uuid.uuid4().hex[:12]}"
