"""Publishing the topics of the topic table on a zenoh session, as a ROS 2 node would."""

from __future__ import annotations

import time
from typing import Any

import zenoh
from zenoh import ext

from msgs import topics
from msgs.topics import Distribution, Topic

_NODE_ID = 0
_HEARTBEAT_S = 1.0


class TopicPublisher:
    """One publisher and its liveliness token. Not thread-safe; created by `Node.publisher`."""

    def __init__(
        self,
        publisher: zenoh.Publisher | ext.AdvancedPublisher,
        token: zenoh.LivelinessToken | None,
        topic: Topic,
        gid: bytes,
    ) -> None:
        self.topic = topic
        self.key = str(publisher.key_expr)
        self.sequence = 0  # of the last sample put
        self._publisher = publisher
        self._token = token
        self._gid = gid

    def put(self, payload: bytes) -> None:
        """Put one CDR payload. Raises zenoh.ZError once the session is closed."""
        self.sequence += 1
        self._publisher.put(payload, attachment=topics.attachment(self.sequence, time.time_ns(), self._gid))

    def matching(self) -> bool:
        """Whether anybody subscribes; always True with a cache. Raises zenoh.ZError once the session is closed."""
        if not isinstance(self._publisher, zenoh.Publisher):
            return True
        status: Any = self._publisher.matching_status
        return bool(status.matching)

    def close(self) -> None:
        if self._token is not None:
            self._token.undeclare()
        self._publisher.undeclare()


class Node:
    """The ROS 2 node `/<uav>/<name>` on a session; closing it closes its publishers.

    With the distribution "off" nothing is announced to ROS, and keys end after the topic.
    """

    def __init__(
        self,
        session: zenoh.Session,
        uav: str,
        *,
        domain: int = 0,
        distribution: Distribution = "jazzy",
        name: str = topics.NODE_NAME,
    ) -> None:
        self._session = session
        self._uav = topics.check_uav_name(uav)
        self._domain = domain
        self._distribution: Distribution = distribution
        self._name = name
        self._zid = str(session.zid())
        self._entity_id = _NODE_ID
        self._publishers: list[TopicPublisher] = []
        self._token = self._announce(topics.node_token(self._zid, _NODE_ID, uav, domain=domain, node=name))

    def publisher(self, topic: Topic, target: str | None = None) -> TopicPublisher:
        """Declare a publisher for a topic with its quality of service; `target` (`t0`, …) for per-target topics."""
        self._entity_id += 1
        key = topics.publication_key(topic, self._uav, target, domain=self._domain, distribution=self._distribution)
        token = topics.publisher_token(
            self._zid,
            _NODE_ID,
            self._entity_id,
            topic,
            self._uav,
            target,
            domain=self._domain,
            distribution=self._distribution,
            node=self._name,
        )
        made = TopicPublisher(declare(self._session, topic, key), self._announce(token), topic, topics.gid(token))
        self._publishers.append(made)
        return made

    def close(self) -> None:
        for publisher in self._publishers:
            publisher.close()
        self._publishers.clear()
        if self._token is not None:
            self._token.undeclare()
            self._token = None

    def __enter__(self) -> Node:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _announce(self, token: str) -> zenoh.LivelinessToken | None:
        return None if self._distribution == "off" else self._session.liveliness().declare_token(token)


def declare(session: zenoh.Session, topic: Topic, key: str) -> zenoh.Publisher | ext.AdvancedPublisher:
    """A zenoh publisher on `key` with the topic's quality of service and, if it has one, its cache."""
    # Never "express": each sample would be its own batch, and the queue holds few. With eight targets, samples waited
    # for room, some were lost even on loopback, and latency was no lower.
    quality = {
        "encoding": topics.encoding(topic),
        "congestion_control": topic.congestion,
        "priority": topic.priority,
        "reliability": topic.reliability,
    }
    if not topic.cache:
        return session.declare_publisher(key, **quality)  # type: ignore[arg-type]
    return ext.declare_advanced_publisher(
        session,
        key,
        **quality,  # type: ignore[arg-type]
        cache=ext.CacheConfig(max_samples=topic.cache),
        sample_miss_detection=ext.MissDetectionConfig(heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None),
        publisher_detection=True,
    )
