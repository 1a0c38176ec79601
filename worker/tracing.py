"""Traces by OpenTelemetry, where the extra ``smsr[otel]`` is installed and OTEL_* variables ask.

They ask by an address (``OTEL_EXPORTER_OTLP_ENDPOINT`` or ``OTEL_EXPORTER_OTLP_TRACES_ENDPOINT``)
or by ``OTEL_TRACES_EXPORTER`` (otlp, console). Else nothing of OpenTelemetry is imported, and a
span costs a function call.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import threading
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import structlog

if TYPE_CHECKING:
    from collections.abc import Iterator

    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import SpanExporter
    from opentelemetry.trace import Span as OtelSpan

Kind: TypeAlias = Literal["internal", "server", "producer", "consumer"]

CLOSE_SECONDS = 2.0
"""How long the last spans may take to their receiver; later ones are given up."""

_ADDRESSES = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
_SDK = "opentelemetry.sdk.trace.export"
_EXPORTER = "opentelemetry.exporter.otlp.proto.http.trace_exporter"

log = structlog.get_logger(__name__)


def exporter_name() -> Literal["otlp", "console"] | None:
    """Return where the environment sends traces; None for nowhere."""
    if os.environ.get("OTEL_SDK_DISABLED", "").strip().lower() == "true":
        return None
    name = os.environ.get("OTEL_TRACES_EXPORTER", "").strip().lower()
    if not name:
        return "otlp" if any(os.environ.get(address) for address in _ADDRESSES) else None
    match name:
        case "otlp" | "console":
            return name
        case "none":
            return None
    log.warning("there is no such exporter of traces", exporter=name, known=["otlp", "console"])
    return None


def preload() -> None:
    """Import what traces need, so that forked processes need not."""
    name = exporter_name()
    if name is not None:
        with contextlib.suppress(ImportError):
            importlib.import_module(_EXPORTER if name == "otlp" else _SDK)


class Span:
    """A part of a trace, or nothing where there are no traces.

    Parameters
    ----------
    span : opentelemetry.trace.Span, optional
    """

    def __init__(self, span: OtelSpan | None = None) -> None:
        self._span = span

    @property
    def traceparent(self) -> str | None:
        """What others name as their parent (W3C Trace Context, section 3.2)."""
        if self._span is None:
            return None
        context = self._span.get_span_context()
        return f"00-{context.trace_id:032x}-{context.span_id:016x}-{context.trace_flags:02x}"

    @property
    def trace_id(self) -> str | None:
        """Id of the trace, 32 hexadecimal digits."""
        return None if self._span is None else f"{self._span.get_span_context().trace_id:032x}"

    def name(self, name: str) -> None:
        """Give the span another name."""
        if self._span is not None:
            self._span.update_name(name)

    def set(self, **attributes: str | float | None) -> None:
        """Note facts; dots of their names are written as two underscores."""
        if self._span is not None:
            for name, value in attributes.items():
                if value is not None:
                    self._span.set_attribute(name.replace("__", "."), value)

    def fail(self, reason: str) -> None:
        """Note that what the span stands for failed."""
        if self._span is not None:
            from opentelemetry.trace import Status, StatusCode

            self._span.set_status(Status(StatusCode.ERROR, reason))

    def end(self) -> None:
        """End it; for one of `Tracing.begin`."""
        if self._span is not None:
            self._span.end()


class Tracing:
    """Makes spans and sends them; thread-safe, but made after a fork and not before.

    Parameters
    ----------
    service : str
        Name of the service, unless OTEL_SERVICE_NAME or OTEL_RESOURCE_ATTRIBUTES has one.
    """

    def __init__(self, service: str) -> None:
        self._provider: TracerProvider | None = None
        name = exporter_name()
        if name is None:
            return
        try:
            self._provider = _provider(service, name)
        except ImportError as error:
            log.warning("traces are asked for, but smsr[otel] is not installed", missing=error.name)
            return
        self._tracer = self._provider.get_tracer("smsr")

    @property
    def on(self) -> bool:
        """Whether spans are made."""
        return self._provider is not None

    def begin(
        self,
        name: str,
        *,
        parent: str | None = None,
        kind: Kind = "internal",
        **attributes: str | float | None,
    ) -> Span:
        """Begin a span that is ended by `Span.end`.

        Parameters
        ----------
        name : str
        parent : str, optional
            A ``traceparent``; by default the current span.
        kind : {'internal', 'server', 'producer', 'consumer'}
        **attributes
            As for `Span.set`.
        """
        if self._provider is None:
            return Span()
        from opentelemetry.trace import SpanKind
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

        context = None
        if parent:
            context = TraceContextTextMapPropagator().extract({"traceparent": parent})
        span = Span(self._tracer.start_span(name, context=context, kind=SpanKind[kind.upper()]))
        span.set(**attributes)
        return span

    @contextlib.contextmanager
    def span(
        self,
        name: str,
        *,
        parent: str | None = None,
        kind: Kind = "internal",
        **attributes: str | float | None,
    ) -> Iterator[Span]:
        """Make a span current while a block runs; the parameters are those of `begin`."""
        span = self.begin(name, parent=parent, kind=kind, **attributes)
        if span._span is None:
            yield span
            return
        from opentelemetry.trace import use_span

        with use_span(span._span, end_on_exit=True, record_exception=False):
            yield span

    def close(self) -> None:
        """Send what is left; a receiver that does not answer is not waited for long."""
        if self._provider is not None:
            closing = threading.Thread(target=self._provider.shutdown, daemon=True)
            closing.start()
            closing.join(CLOSE_SECONDS)


def _provider(service: str, exporter: Literal["otlp", "console"]) -> TracerProvider:
    from opentelemetry.sdk.resources import Resource
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import BatchSpanProcessor

    import smsr

    attributes: dict[str, Any] = {"service.version": smsr.__version__}
    named = "service.name=" in os.environ.get("OTEL_RESOURCE_ATTRIBUTES", "")
    if not (os.environ.get("OTEL_SERVICE_NAME") or named):
        attributes["service.name"] = service
    provider = TracerProvider(resource=Resource.create(attributes), shutdown_on_exit=False)
    provider.add_span_processor(BatchSpanProcessor(_exporter(exporter)))
    return provider


def _exporter(name: Literal["otlp", "console"]) -> SpanExporter:
    if name == "console":
        import sys

        from opentelemetry.sdk.trace.export import ConsoleSpanExporter

        return ConsoleSpanExporter(out=sys.stderr, formatter=lambda s: s.to_json(None) + "\n")
    from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter

    return OTLPSpanExporter()
