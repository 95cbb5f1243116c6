"""Prints the proposals for a library's photos, and what was written or undone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import typer
from rich.markup import escape
from rich.table import Column

from services.cli.locate.library import LibraryPhoto, LocatedPhoto, UndoReport, WriteReport
from services.cli.locate.preview import Preview
from services.cli.output import (
    Json,
    Table,
    err_console,
    format_percent,
    print_json,
    print_message,
    print_note,
    print_table,
    printable_text,
)


@dataclass(frozen=True, slots=True)
class LocateOptions:
    """The options that the commands share, and how they name what they write."""

    accept: float
    radius_m: float
    motion: str
    together: bool
    gpx: Path | None
    picture: bool
    server: str | None
    map_name: str | None
    write: bool
    as_json: bool
    how_to_write: str
    undo_command: str
    written_are: str
    """in the plural, such as files"""


def print_changes(preview: Preview, accepted: Sequence[LocatedPhoto]) -> None:
    """Say of which preview the written proposals are, and which of them it did not show so."""
    shown = preview.accepted
    present = {each.photo.name: each.shown() for each in accepted}
    changed = [name for name in {**shown, **present} if shown.get(name) != present.get(name)]
    print_note(
        f"The searches are those of {preview.searched_at.astimezone():%Y-%m-%d %H:%M}; without "
        "--write, the photos are searched again. "
        + (
            f"{len(changed)} proposals are not as they were accepted then, because options, photos "
            f"or the track have changed: {', '.join(changed[:3])}"
            + (" ..." if len(changed) > 3 else "")
            if changed
            else "All proposals are as they were then."
        )
    )


def to_json(
    photos: Sequence[LibraryPhoto],
    located: Sequence[LocatedPhoto],
    accept: float,
    written: WriteReport | None,
) -> Json:
    """Return all that is known about a library's photos, with `accept` as the probability."""
    return {
        "photos": len(photos),
        "with_coordinates": sum(photo.latitude is not None for photo in photos),
        "not_understood": [
            {"filename": photo.name, "reason": photo.gps_error}
            for photo in photos
            if photo.gps_error
        ],
        "accept": accept,
        "proposals": [
            {
                "filename": each.photo.name,
                "captured_at": each.photo.time.isoformat() if each.photo.time else None,
                "time_zone_is_known": each.photo.time_zone_is_known,
                "accepted": each.probability >= max(accept, 1e-9),
                "position": asdict(each.proposal) if each.proposal else None,
                "place": each.place,
                "place_probability": each.place_probability,
                "why_unknown": None if each.proposal else each.why_unknown,
                "error": each.error,
            }
            for each in located
        ],
        "written": asdict(written) if written else None,
    }


def print_proposals(
    options: LocateOptions,
    photos: Sequence[LibraryPhoto],
    located: Sequence[LocatedPhoto],
    accepted: Sequence[LocatedPhoto],
    written: WriteReport | None,
) -> None:
    """Print the proposals as a table, and what was written."""
    table = Table(
        "photo",
        Column("latitude", no_wrap=True),
        Column("longitude", no_wrap=True),
        *(["place"] if any(each.place for each in located) else []),
        Column("within", justify="right", no_wrap=True),
        Column("prob.", justify="right", no_wrap=True),
        "reason",
    )
    for each in located:
        position = each.proposal
        table.add_row(
            escape(each.photo.name),
            f"{position.latitude:.6f}" if position else "",
            f"{position.longitude:.6f}" if position else "",
            *([escape(each.place or "")] if any(each.place for each in located) else []),
            f"{position.radius_m:.0f} m" if position else "",
            format_percent(each.probability) if position or each.place else "",
            escape(each.error or (position.reason if position else each.why_unknown)),
            style=None if each in accepted else "dim",
        )
    with_coordinates = sum(photo.latitude is not None for photo in photos)
    for photo in photos:
        if photo.gps_error:
            line = f"{printable_text(photo.name)}: {photo.gps_error}"
            err_console.print(f"[red]left as it is[/red] {escape(line)}", soft_wrap=True)
    if not located:
        print_message(
            f"{with_coordinates} of {len(photos)} photos have coordinates: there is nothing to "
            "locate."
        )
        return
    print_table(table)
    print_message(
        f"{with_coordinates} of {len(photos)} photos have coordinates; "
        f"{len(accepted)} of the {len(located)} others have a proposal with at least "
        f"{100 * options.accept:g} %."
    )
    without_zone = sum(p.time is not None and not p.time_zone_is_known for p in photos)
    if without_zone:
        print_note(
            f"The clocks of {without_zone} photos have no time zone, so that they are compared "
            "with one another only. Pass it: --time-zone +02:00 or --time-zone Europe/Paris."
        )
    if written is None:
        if accepted:
            print_note(f"Nothing is written. {options.how_to_write} writes them.")
        return
    names = ", ".join(map(printable_text, written.written[:3])) + (
        " ..." if len(written.written) > 3 else ""
    )
    print_note(
        f"{len(written.written)} {options.written_are} written{': ' if names else ''}{names}. "
        f"Undo: {options.undo_command}"
    )
    for name, reason in written.skipped.items():
        line = f"[red]skipped[/red] {escape(printable_text(name))}: {escape(reason)}"
        err_console.print(line, soft_wrap=True)


def report_undo(report: UndoReport, message: str, as_json: bool) -> None:
    """Print what was undone; exits with 1 if something was left as it is."""
    if as_json:
        print_json(asdict(report))
    else:
        print_note(message)
        for name in report.changed_since:
            err_console.print(
                f"[red]changed since[/red] {escape(printable_text(name))}: left as it is",
                soft_wrap=True,
            )
    if report.changed_since:
        raise typer.Exit(1)
