"""The operator's page, as a sink; up as soon as it is constructed, so that a start can be watched too."""

import logging
from collections.abc import Mapping
from pathlib import Path

from service.encoding import WARNING, Message, Status
from service.errors import StorageError
from service.mapper.profiles import METHODS
from service.outputs import reason_value
from service.publishing.certificate import UNTIL, Validity
from service.publishing.commands import Answer, refusal
from service.sinks.sink import Sink, SinkContext
from service.web.access import new_token, state_folder, token_from_file
from service.web.config import WebConfig
from service.web.resources import Kind
from service.web.server import About, WebServer
from service.web.tokens import granted_beside

log = logging.getLogger(__name__)


def open_sink(config: WebConfig, context: SinkContext) -> "WebSink | None":
    return WebSink(config, context) if config.enabled else None


class WebSink(Sink):
    """Takes commands from `start` on. A port or token it cannot have shows in health; mapping goes on."""

    name = "web"

    def __init__(self, config: WebConfig, context: SinkContext) -> None:
        self._command = context.command
        self._is_started = False
        self._token_fault = ""
        self._validity = Validity(config.tls_certificate, config.tls_key)
        path = config.token_file or state_folder() / "web.token"
        self.server = WebServer(
            config,
            About(
                context.vehicle,
                context.profile,
                lambda: context.verbs() if self._is_started else (),
                tuple(METHODS),
            ),
            context.tiles,
            self._answer,
            self._token(path),
            _folders(context),
            granted=granted_beside(path),
        )
        self.server.start()

    def start(self) -> None:
        self._is_started = True

    def put(self, message: Message, arrived_ns: int | None = None) -> None:
        self.server.put(message, arrived_ns)

    def health(self) -> Status:
        status = self.server.health()
        if until := self._validity.until:
            status = status._replace(values={**status.values, UNTIL: until})
        if status.level < WARNING and (fault := self._validity.fault()):
            values = {**status.values, **reason_value("certificate_not_valid")}
            return Status(self.name, WARNING, fault, values)
        if self._token_fault and status.level < WARNING:
            values = {**status.values, **reason_value("token_unreadable")}
            return Status(self.name, WARNING, f"commands are refused: {self._token_fault}", values)
        return status

    def place(self) -> str:
        return self.server.address

    def close(self) -> None:
        self.server.close()

    def _token(self, path: Path) -> str:
        try:
            token = token_from_file(path)
        except StorageError as error:
            self._token_fault = str(error)
            log.error("web: commands are refused: %s", error)
            return new_token()  # that no one gets
        log.info("web: the token that commands need is in %s", path)
        return token

    def _answer(self, verb: str, payload: bytes) -> Answer:
        if not self._is_started:
            return refusal("the service is still starting; ask again when it maps")
        return self._command(verb, payload)


def _folders(context: SinkContext) -> Mapping[Kind, Path] | None:
    """None where the service stores no sessions or no maps."""
    try:
        return {"session": context.folders["recording"], "map": context.folders["map"]}
    except KeyError:
        return None
