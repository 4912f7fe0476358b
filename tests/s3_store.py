"""moto's server on this machine in place of S3, to which the environment points."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest


@contextmanager
def s3_store(bucket: str) -> Iterator[Any]:
    """Yield a client of a store with an empty bucket; skips where what it takes is not installed."""
    s3fs = pytest.importorskip("s3fs", reason="writes s3://: pip install 'pdhef-logtool[s3]'")
    pytest.importorskip("moto.server", reason="stands for S3: pip install 'moto[server]'")
    import botocore.session
    from moto.server import ThreadedMotoServer

    from pdhef_logtool.records import object_store

    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
            for name, value in (("ACCESS_KEY_ID", "key"), ("SECRET_ACCESS_KEY", "hidden")):
                patch.setenv(f"AWS_{name}", value)
            patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
            s3fs.S3FileSystem.clear_instance_cache()
            object_store._opened.cache_clear()
            client = botocore.session.get_session().create_client("s3")
            client.create_bucket(Bucket=bucket)
            yield client
    finally:
        s3fs.S3FileSystem.clear_instance_cache()
        object_store._opened.cache_clear()
        server.stop()


def objects_of(client: Any, bucket: str, prefix: str) -> dict[str, bytes]:
    """Return what lies below a prefix, by the name there."""
    found = client.get_paginator("list_objects_v2").paginate(Bucket=bucket, Prefix=f"{prefix}/")
    keys = [entry["Key"] for page in found for entry in page.get("Contents", ())]
    return {
        key.removeprefix(f"{prefix}/"): client.get_object(Bucket=bucket, Key=key)["Body"].read() for key in sorted(keys)
    }
