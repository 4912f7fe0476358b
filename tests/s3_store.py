"""moto's server on this machine in place of S3, to which the environment points."""

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import pytest

from tests.counting_server import empty_cache

#: moto keeps its buckets for the life of the process, whichever server they were made through.
_numbers = itertools.count(1)


@dataclass(frozen=True)
class S3Store:
    """A bucket of one test, and a client of the store that contains it."""

    client: Any
    bucket: str

    @property
    def url(self) -> str:
        return f"s3://{self.bucket}"

    def put(self, key: str, body: bytes) -> None:
        self.client.put_object(Bucket=self.bucket, Key=key, Body=body)

    def get(self, key: str) -> bytes:
        body: bytes = self.client.get_object(Bucket=self.bucket, Key=key)["Body"].read()
        return body

    def objects(self, prefix: str) -> dict[str, bytes]:
        """Return the objects below a prefix, by their names there."""
        pages = self.client.get_paginator("list_objects_v2").paginate(Bucket=self.bucket, Prefix=f"{prefix}/")
        keys = sorted(entry["Key"] for page in pages for entry in page.get("Contents", ()))
        return {key.removeprefix(f"{prefix}/"): self.get(key) for key in keys}


def forget_file_systems() -> None:
    """Drop the file systems that this process has opened, with their connections and listings."""
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()


@contextmanager
def s3_store() -> Iterator[S3Store]:
    """Yield a store with a new, empty bucket; skip the test if the needed packages are not installed."""
    pytest.importorskip("s3fs", reason="writes s3://: pip install 'pdhef-logtool[s3]'")
    pytest.importorskip("moto.server", reason="replaces S3: pip install 'moto[server]'")
    import botocore.session
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    try:
        with empty_cache(), pytest.MonkeyPatch.context() as patch:
            patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
            for name, value in (("ACCESS_KEY_ID", "key"), ("SECRET_ACCESS_KEY", "hidden")):
                patch.setenv(f"AWS_{name}", value)
            patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
            forget_file_systems()
            client = botocore.session.get_session().create_client("s3")
            store = S3Store(client, f"cars-{next(_numbers)}")
            client.create_bucket(Bucket=store.bucket)
            yield store
    finally:
        forget_file_systems()
        server.stop()
