"""Access to Zenoh: settings, and the access control rules.

A name is the common name of a certificate, or that of a user. Its role decides: a viewer reads, an operator
commands besides, a vehicle publishes below its own name. Without a role nothing is allowed.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from drivers.section import Section
from service.errors import StorageError
from service.private_file import read_private
from service.publishing.keys import ROOT

LOCAL_PROTOCOLS = ("tcp", "udp", "ws", "unixsock-stream")  # a config has these on this machine alone
MAX_PASSWORDS_BYTES = 1_000_000

_FOLLOW = ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query")
_ALL = (*_FOLLOW, "query", "put", "delete", "reply", "declare_queryable", "liveliness_token")

# Not one that ends another key: it stands between slashes, and Zenoh's file of users divides at the colon.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.@-]*$", max_length=64)]
Rule = dict[str, Any]


class TlsConfig(Section):
    """PEM files. Without `users`, who connects shows a certificate of the same authority."""

    ca: Path
    certificate: Path
    key: Path


class UsersConfig(Section):
    """file: lines name:password; name: the one of them by which this service connects to other routers."""

    file: Path
    name: Name | None = None


class RolesConfig(Section):
    """Names of each role."""

    viewer: tuple[Name, ...] = ("viewer",)
    operator: tuple[Name, ...] = ("operator",)
    vehicle: tuple[Name, ...] = ()

    @property
    def names(self) -> frozenset[str]:
        """All that have a role."""
        return frozenset((*self.viewer, *self.operator, *self.vehicle))

    @model_validator(mode="after")
    def _one_role_each(self) -> "RolesConfig":
        names = [*self.viewer, *self.operator, *self.vehicle]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"{twice[0]} has two roles; list each name once")
        return self


class SecurityConfig(Section):
    """Neither tls nor users: none is requested, as where the section is left out."""

    tls: TlsConfig | None = None
    users: UsersConfig | None = None
    roles: RolesConfig = RolesConfig()

    @property
    def is_on(self) -> bool:
        return self.tls is not None or self.users is not None


# "none": explicitly, other machines may connect without a certificate.
Security = Annotated[
    Annotated[SecurityConfig, Tag("settings")] | Annotated[Literal["none"], Tag("none")],
    Discriminator(lambda given: "settings" if isinstance(given, dict | SecurityConfig) else "none"),
]


def link_settings(security: SecurityConfig) -> dict[str, Any]:
    """Settings by which a Zenoh session authenticates itself and others, by path.

    Raises StorageError where a file cannot be read, or others may read it.
    """
    settings: dict[str, Any] = {}
    if (tls := security.tls) is not None:
        read_private(tls.key, "the key of publishing.security", 0)
        settings["transport/link/tls"] = {
            "root_ca_certificate": str(tls.ca),
            **{f"{side}_certificate": str(tls.certificate) for side in ("listen", "connect")},
            **{f"{side}_private_key": str(tls.key) for side in ("listen", "connect")},
            "enable_mtls": security.users is None,
            "verify_name_on_connect": True,
        }
    if (users := security.users) is not None:
        passwords = read_private(users.file, "passwords of publishing.security", MAX_PASSWORDS_BYTES)
        settings["transport/auth/usrpwd"] = {"dictionary_file": str(users.file)}
        if users.name is not None:
            settings["transport/auth/usrpwd"] |= {
                "user": users.name,
                "password": _password(passwords, users),
            }
    return settings


def access_control(
    security: SecurityConfig, ros2_domain: int | None, trusts_plain: bool = True
) -> dict[str, Any]:
    """Zenoh's section of that name.

    ros2_domain    None where there are no topics of ROS 2
    trusts_plain   whether who comes without TLS may do everything, as at endpoints of this machine alone
    """
    native = _with_caches(f"{ROOT}/**")
    topics, tokens = [], []
    if ros2_domain is not None:
        topics, tokens = _with_caches(f"{ros2_domain}/**"), [f"@ros2_lv/{ros2_domain}/**"]
    rules: list[Rule] = [
        _rule("send", _ALL, [*native, *topics, *tokens], flow="egress"),
        _rule("follow", _FOLLOW, native),
        _rule("ask", ("query",), native),
        _rule("view", ("query",), [f"{ROOT}/*/cmd/**"], permission="deny"),
        _rule("command", ("put",), [f"{ROOT}/*/initialpose"]),
    ]
    of_role = {"viewer": ["send", "follow", "ask", "view"], "operator": ["send", "follow", "ask", "command"]}
    if topics:
        rules += _topic_rules(ros2_domain, topics, tokens)
        of_role["viewer"] += ["follow-topics", "ask-late"]
        of_role["operator"] += ["follow-topics", "call", "set-pose", "join"]
    subjects, policies = [], []

    def allow(who: str, names: Sequence[str], allowed: list[str]) -> None:
        """Rule by user where there are users; by certificate for a router to which this service connects."""
        kinds = {"usernames": security.users is not None, "cert_common_names": security.tls is not None}
        for kind in (kind for kind, is_used in kinds.items() if is_used and names):
            subjects.append({"id": f"{who}-{kind}", kind: list(names)})
            policies.append({"rules": allowed, "subjects": [f"{who}-{kind}"]})

    for role, allowed in of_role.items():
        allow(role, getattr(security.roles, role), allowed)
    for name in security.roles.vehicle:
        rules.append(_rule(f"publish-{name}", _ALL, _with_caches(f"{ROOT}/{name}/**")))
        allowed = ["send", "follow", f"publish-{name}", *(["publish-topics"] if topics else [])]
        allow(f"vehicle-{name}", (name,), allowed)
    if trusts_plain and security.users is None:
        everything = [*_with_caches("**"), "@ros2_lv/**", "@/**"]
        rules += [_rule(f"local-{flow}", _ALL, everything, flow=flow) for flow in ("ingress", "egress")]
        subjects.append({"id": "local", "link_protocols": list(LOCAL_PROTOCOLS)})
        policies.append({"rules": ["local-ingress", "local-egress"], "subjects": ["local"]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _topic_rules(ros2_domain: int | None, topics: list[str], tokens: list[str]) -> list[Rule]:
    """Of topics of ROS 2, and of the liveliness tokens of its nodes."""
    return [
        _rule("follow-topics", _FOLLOW, [*topics, *tokens]),
        _rule("ask-late", ("query",), topics[1:]),
        _rule("call", ("query",), topics),
        _rule("set-pose", ("put",), [f"{ros2_domain}/**/initialpose/**"]),
        _rule("join", ("liveliness_token",), tokens),
        _rule("publish-topics", _ALL, [*topics, *tokens]),
    ]


def _with_caches(keys: str) -> list[str]:
    """And those by which an advanced subscriber requests what it has missed: ** stands for no @adv."""
    return [keys, f"{keys}/@adv/**"]


def _rule(
    name: str, messages: Sequence[str], keys: list[str], flow: str = "ingress", permission: str = "allow"
) -> Rule:
    return {
        "id": name,
        "permission": permission,
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": keys,
    }


def _password(passwords: bytes, users: UsersConfig) -> str:
    try:
        lines = passwords.decode().splitlines()
    except UnicodeDecodeError as error:
        raise StorageError(f"{users.file}: no text of UTF-8: {error.reason}") from error
    for line in lines:
        user, separator, password = line.partition(":")
        if separator and user == users.name:
            return password
    raise StorageError(
        f"{users.file}: no line {users.name}:<password>, and publishing.security.users.name is {users.name}"
    )
