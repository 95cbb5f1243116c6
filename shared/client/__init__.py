"""HTTP API client that returns the API's JSON; used by the command line.

    with Client("http://127.0.0.1:8000") as places:  # beyond loopback: Client(url, key="pw_...")
        uploaded = places.upload(Path("street.jpg"), latitude=45.07, longitude=7.69)
        places.wait_for(uploaded["job_id"])
        answer = places.similar_to_file(Path("where.jpg"), top_k=5)

Error responses are raised as the PlacewiseError with their status and `code`. If the server can't
be reached, Unavailable (`server_unreachable`) is raised.

With `patience_seconds`, calls are retried while the server is unavailable or busy. Calls that
create a job or a record carry one Idempotency-Key for all attempts, so that they take effect once
even if responses are lost.

The package `placewise` provides the same calls with typed responses.
"""

from shared.client.async_calls import AsyncClient
from shared.client.calls import Client
from shared.client.sending import FINISHED, Json

__all__ = ["FINISHED", "AsyncClient", "Client", "Json"]
