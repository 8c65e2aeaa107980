"""The log of a process on the bus: lines of text, or one JSON object for each record."""

from __future__ import annotations

import argparse
import json
import logging
from datetime import UTC, datetime

from proto.plain_text import plain_lines


class ProcessLog:
    """Writes the log of a process to standard error.

    Attributes:
        name: what writes it: a role in a run, or a command.
        run: name of the run; empty until it is known.
        id: id of the process; empty until it is known.
    """

    def __init__(self, name: str, arguments: argparse.Namespace) -> None:
        """Start to log.

        Args:
            name: what writes the log: a role in a run, or a command.
            arguments: the parsed arguments of `services.arguments.common.add_log_options`.
        """
        self.name = name
        self.run = ""
        self.id = ""
        handler = logging.StreamHandler()
        if arguments.log_format == "json":
            handler.setFormatter(_JsonFormatter(self))
        else:
            handler.setFormatter(_plain_formatter(name))
        level = logging.INFO
        if arguments.quiet:
            level = logging.WARNING
        logging.basicConfig(level=level, handlers=[handler], force=True)
        if arguments.verbose:  # details of our own modules, not of libraries
            for package in ("proto", "learner", "actors", "services"):
                logging.getLogger(package).setLevel(logging.DEBUG)


def start_logging(name: str) -> None:
    """Log to standard error, for a command whose log has no options.

    Args:
        name: stands in each line, beside the time.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(_plain_formatter(name))
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)


def _plain_formatter(name: str) -> logging.Formatter:
    return _PlainFormatter(f"%(asctime)s {name} %(levelname)s %(message)s")


class _PlainFormatter(logging.Formatter):
    """Writes each record so that no text in it can look like another record.

    The further lines of a message and of a stack trace are indented.
    """

    def format(self, record: logging.LogRecord) -> str:
        return "\n    ".join(plain_lines(super().format(record)).split("\n"))


class _JsonFormatter(logging.Formatter):
    """Writes each record as a JSON object in one line."""

    def __init__(self, log: ProcessLog) -> None:
        super().__init__()
        self._log = log

    def format(self, record: logging.LogRecord) -> str:
        told = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "run": self._log.run,
            "role": self._log.name,
            "id": self._log.id,
            "message": plain_lines(record.getMessage()),
        }
        if record.exc_info:
            told["trace"] = plain_lines(self.formatException(record.exc_info))
        return json.dumps(told)
