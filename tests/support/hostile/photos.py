"""Photos that are none, were cut off, or are two things at once."""

from __future__ import annotations

import gzip
import random
import struct
from collections.abc import Iterator

from tests.support.archives import zip_of
from tests.support.hostile.file import (
    ANYTHING_SAID,
    BROKEN,
    FINE,
    FORMATS,
    MAX_BYTES,
    NO_PHOTO,
    Hostile,
    photo,
)


def of_another_kind() -> Iterator[Hostile]:
    kinds = {
        "gif": b"GIF89a" + bytes(100),
        "pdf": b"%PDF-1.7\n1 0 obj\n",
        "html": b"<!doctype html><script>alert(1)</script>",
        "svg": b"<svg xmlns='http://www.w3.org/2000/svg' onload='alert(1)'/>",
        "svg that includes a file": b"<!DOCTYPE s [<!ENTITY x SYSTEM 'file:///etc/passwd'>]><s>&x;</s>",
        "program": b"\x7fELF\x02\x01\x01" + bytes(100),
        "windows program": b"MZ\x90\x00" + bytes(100),
        "java class": b"\xca\xfe\xba\xbe" + bytes(100),
        "web assembly": b"\0asm\x01\0\0\0" + bytes(100),
        "shell script": b"#!/bin/sh\nrm -rf /\n",
        "php": b"<?php system($_GET['c']); ?>",
        "postscript": b"%!PS-Adobe-3.0 EPSF-3.0\n(/etc/passwd) (r) file\n",
        "image magick": b"push graphic-context\nfill 'url(https://127.0.0.1/|id)'\n",
        "zip": zip_of({"a.jpg": photo(0)}),
        "gzip": gzip.compress(photo(0)),
        "7z": b"7z\xbc\xaf\x27\x1c" + bytes(100),
        "rar": b"Rar!\x1a\x07\x01\x00" + bytes(100),
        "sqlite": b"SQLite format 3\0" + bytes(100),
        "mp4": b"\0\0\0\x20ftypisom" + bytes(100),
        "avif": b"\0\0\0\x20ftypavif" + bytes(100),
        "psd": b"8BPS\0\x01" + bytes(100),
        "icon": b"\0\0\x01\0\x01\0" + bytes(100),
        "text that begins like a bitmap": b"BMost of this is text, and no picture.",
        "one byte": b"\xff",
        "zeros": bytes(1000),
        "blanks": b" " * 1000,
    }
    for kind, data in kinds.items():
        yield Hostile(f"{kind} called a photo", data, NO_PHOTO)
    yield Hostile("nothing", b"", frozenset({"empty_file"}))
    too_large = photo(1) + bytes(MAX_BYTES)
    yield Hostile("more bytes than allowed", too_large, frozenset({"file_too_large"}))


def cut_off() -> Iterator[Hostile]:
    for media in FORMATS:
        whole = photo(2, media)
        for length in (2, 4, 12, 30, len(whole) // 4, len(whole) // 2, len(whole) * 9 // 10):
            yield Hostile(f"{media} cut off after {length} bytes", whole[:length], BROKEN)


def polyglots() -> Iterator[Hostile]:
    page = b"<html><script>alert(1)</script></html>"
    yield Hostile("JPEG and page", photo(20) + page, FINE, "photo.html")
    yield Hostile("JPEG and zip", photo(21) + zip_of({"a": b"b"}), FINE, "photo.zip")
    yield Hostile("JPEG and program", photo(22) + b"\x7fELF" + bytes(99), FINE, "photo.exe")
    php = b"\xff\xfe" + struct.pack(">H", 30) + b"<?php system($_GET['c']); ?>"
    whole = photo(23)
    yield Hostile("JPEG with a program in a comment", whole[:2] + php + whole[2:], FINE, "x.php")
    png = photo(24, "PNG")
    yield Hostile("PNG and page", png + page, FINE, "photo.svg")
    yield Hostile("GIF and JPEG", b"GIF89a" + photo(25), NO_PHOTO)
    yield Hostile("PDF and JPEG", b"%PDF-1.7\n" + photo(26), NO_PHOTO)
    yield Hostile("page and JPEG", page + photo(27), NO_PHOTO)


def noise() -> Iterator[Hostile]:
    dice = random.Random(2)
    for media in FORMATS:
        for seed in range(5):
            data = bytearray(photo(100 + seed, media))
            for _ in range(2**seed):
                data[dice.randrange(4, len(data))] = dice.randrange(256)
            yield Hostile(f"{media} with noise {seed}", bytes(data), ANYTHING_SAID)
