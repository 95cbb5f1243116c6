"""Archives of strangers, read from the object store: what is in them, and one member at a time.

A member is found by its place alone, so that a batch goes on after a restart without reading the
archive from its begin (but for a gzipped one). Names are labels: nothing is ever written under one.
Whatever an archive declares is bounded before it is believed.
"""

from services.steward.archives.member import Archive, ArchiveLimits, ArchiveMember
from services.steward.archives.open_archive import open_archive

__all__ = ["Archive", "ArchiveLimits", "ArchiveMember", "open_archive"]
