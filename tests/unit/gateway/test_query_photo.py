"""Jobs that describe a query photo keep the parameters of its search."""

from __future__ import annotations

from services.gateway.similarity.search_params import SearchParams
from services.gateway.uploads.query_photo import describe_query_job, query_job_search_params
from shared.ids import new_id

PARAMS = SearchParams(top_k=7, tags="night")


def test_a_query_job_returns_the_search_parameters_that_it_was_created_with() -> None:
    job = describe_query_job(new_id(), new_id(), "query.jpg", PARAMS)
    assert query_job_search_params(job) == PARAMS
