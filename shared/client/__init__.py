"""A client of the HTTP API that answers with the API's own JSON: what the commands stand on.

    with Client("http://127.0.0.1:8000") as places:  # beyond loopback: Client(url, key="pw_...")
        uploaded = places.upload(Path("street.jpg"), latitude=45.07, longitude=7.69)
        places.wait_for(uploaded["job_id"])
        answer = places.similar_to_file(Path("where.jpg"), top_k=5)

Whatever the server refuses is raised as the error that it raised, with its status and `code`; a
server that can't be reached is Unavailable (`server_unreachable`).

A patient client (`Client(url, patience_seconds=60)`) repeats a call that met a server which is away
or busy. What makes a job or a record is repeated under one Idempotency-Key, so that it is done once
whatever answers were lost.

`placewise` is the same with typed answers.
"""

from shared.client.async_calls import AsyncClient
from shared.client.calls import Client
from shared.client.sending import FINISHED, Json

__all__ = ["FINISHED", "AsyncClient", "Client", "Json"]
