"""The role of a photo in its map, for clients of the API too: it imports no database library."""

from enum import StrEnum


class PhotoRole(StrEnum):
    DATABASE = "database"  # indexed and searchable
    QUERY = "query"  # a labelled query for evaluations: described, but never a search result
