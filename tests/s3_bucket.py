"""An S3 server on loopback."""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from moto.server import ThreadedMotoServer

from service.archive import path_or_url


@contextmanager
def s3_bucket() -> Iterator[Path]:
    """An empty one, s3://site; processes started meanwhile use it."""
    logging.getLogger("werkzeug").setLevel(logging.WARNING)  # else a line for each request
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    address = "http://{}:{}".format(*server.get_host_and_port())
    keys = dict.fromkeys(("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"), "any")
    with patch.dict(os.environ, AWS_ENDPOINT_URL=address, AWS_DEFAULT_REGION="us-east-1", **keys):
        bucket = path_or_url("s3://site")
        bucket.mkdir()
        yield bucket
    server.stop()
