"""Our own messages: values of the core and of the service to `hmt.v1` protobuf and back.

References:
    proto/hmt_service/service/v1/hmt.proto.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import Any, TypeVar

import numpy as np
from google.protobuf.message import DecodeError, Message

from hmt_service.core.geometry import GaussianPose, Pose, pose_of, quaternion_of
from hmt_service.core.types import (
    Arc,
    ArcResidual,
    AreaDetails,
    AreaDifference,
    AreaVisit,
    Belief,
    Comparison,
    Event,
    EventKind,
    GlobalMap,
    History,
    HmtPose,
    Hypotheses,
    HypothesisEffect,
    HypothesisSummary,
    Localization,
    MapMethod,
    PlacedArea,
    Posterior,
    StampedPose,
    StatementEffect,
    Trajectory,
)
from hmt_service.errors import (
    DaemonFailure,
    DeadlineExceeded,
    HmtError,
    InvalidInput,
    NotFound,
    Unavailable,
)
from hmt_service.runtime.messages import Part, ProcessName, ProcessStatus, Wire
from hmt_service.service.keys import Input
from hmt_service.service.reports import Ack, DaemonState, InputCounts, SenderCounts, Status
from hmt_service.service.v1 import hmt_pb2 as pb

PREFIX = "application/protobuf;"
"""Begins the encoding of every payload."""
_FAILURES: dict[str, type[HmtError]] = {
    error.code: error
    for error in (InvalidInput, NotFound, Unavailable, DeadlineExceeded, DaemonFailure)
}

E_ = TypeVar("E_", bound=StrEnum)


def wire(message: Message) -> Wire:
    """Return a protobuf ready to travel."""
    return Wire(message.SerializeToString(), encoding_of(type(message)))


def encoding_of(message: type[Message]) -> str:
    """Return the encoding that payloads of this message travel with."""
    return PREFIX + message.DESCRIPTOR.full_name


Value = (
    HmtPose
    | Posterior
    | Hypotheses
    | History
    | GlobalMap
    | AreaDetails
    | Trajectory
    | Comparison
    | StatementEffect
    | Event
    | tuple[Event, ...]
    | Status
    | Ack
)
"""What the daemon publishes and answers."""


def encode(value: Value | HmtError) -> Wire:
    """Return the payload of a publication, an answer or an error reply."""
    return wire(_message_of(value))


def decode(payload: bytes, encoding: str) -> Value | HmtError:
    """Return the value of a payload of the daemon.

    Raises:
        InvalidInput: If the encoding is not one of ours, or the payload does not hold what it says.
    """
    if encoding not in _DECODERS:
        raise InvalidInput(f"unknown encoding {encoding!r}, {len(payload)} bytes")
    message_type, from_proto = _DECODERS[encoding]
    try:
        return from_proto(message_type.FromString(payload))
    except (DecodeError, ValueError) as error:
        raise InvalidInput(f"{len(payload)} bytes are no {encoding}: {error}") from error


def encode_origin(sender: int, number: int) -> bytes:
    """Return what a sender attaches to a reading.

    Args:
        sender: Number that it has drawn for itself, in [1, 2^64).
        number: Place of the reading among those that it sends under one key, from 0.
    """
    return pb.Origin(sender=sender, number=number).SerializeToString()


def decode_origin(attachment: bytes) -> tuple[int, int] | None:
    """Return sender and number of a reading; None if the attachment does not say them."""
    try:
        origin = pb.Origin.FromString(attachment)
    except DecodeError:
        return None
    return (origin.sender, origin.number) if origin.sender else None


def encode_place(part: Part) -> bytes:
    """Return what is attached to a reply that is only a part of an answer."""
    return pb.Part(number=part.number, count=part.count).SerializeToString()


def decode_place(attachment: bytes) -> tuple[int, int]:
    """Return the place of a part, from 0, and the number of parts.

    Raises:
        InvalidInput: If the attachment says neither.
    """
    try:
        part = pb.Part.FromString(attachment)
    except DecodeError as error:
        raise InvalidInput(f"{len(attachment)} bytes are no hmt.v1.Part: {error}") from error
    if part.number >= part.count:
        raise InvalidInput(f"part {part.number} of {part.count}")
    return part.number, part.count


def _message_of(value: Value | HmtError) -> Message:
    if isinstance(value, HmtError):
        return pb.Error(code=f"ERROR_CODE_{value.code}", message=str(value))
    return _ENCODERS[type(value)](value)


def _transform_to_proto(pose: Pose) -> pb.Pose:
    x, y, z = pose[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_of(pose).tolist()
    return pb.Pose(x_m=x, y_m=y, z_m=z, qx=qx, qy=qy, qz=qz, qw=qw)


def _transform(message: pb.Pose | pb.GaussianPose) -> Pose:
    quaternion = np.array([message.qx, message.qy, message.qz, message.qw])
    return pose_of(quaternion, np.array([message.x_m, message.y_m, message.z_m]))


def _gaussian_to_proto(pose: GaussianPose) -> pb.GaussianPose:
    x, y, z = pose.mean[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_of(pose.mean).tolist()
    covariance = pose.covariance.ravel().tolist()
    return pb.GaussianPose(x_m=x, y_m=y, z_m=z, qx=qx, qy=qy, qz=qz, qw=qw, covariance=covariance)


def _gaussian(message: pb.GaussianPose) -> GaussianPose:
    covariance = np.array(message.covariance, dtype=np.float64).reshape(6, 6)
    return GaussianPose(_transform(message), covariance)


def _pose_to_proto(pose: HmtPose) -> pb.HmtPose:
    return pb.HmtPose(
        stamp_s=pose.stamp_s,
        area=pose.area,
        area_from_body=_gaussian_to_proto(pose.area_from_body),
        reference_area=pose.reference_area,
        reference_from_body=_gaussian_to_proto(pose.reference_from_body),
        hypothesis=pose.hypothesis,
        probability=pose.probability,
        localization=_localization_to_proto(pose.localization),
        revision=pose.revision,
    )


def _pose(message: pb.HmtPose) -> HmtPose:
    return HmtPose(
        stamp_s=message.stamp_s,
        area=message.area,
        area_from_body=_gaussian(message.area_from_body),
        reference_area=message.reference_area,
        reference_from_body=_gaussian(message.reference_from_body),
        hypothesis=message.hypothesis,
        probability=message.probability,
        localization=_localization(message.localization),
        revision=message.revision,
    )


def _localization_to_proto(localization: Localization) -> pb.Localization:
    return pb.Localization(
        stamp_s=localization.stamp_s,
        probability=localization.probability,
        entropy_nat=localization.entropy_nat,
        evidence_stamp_s=localization.evidence_stamp_s,
    )


def _localization(message: pb.Localization) -> Localization:
    has_evidence = message.HasField("evidence_stamp_s")
    return Localization(
        message.stamp_s,
        message.probability,
        message.entropy_nat,
        message.evidence_stamp_s if has_evidence else None,
    )


def _summary_to_proto(summary: HypothesisSummary) -> pb.HypothesisSummary:
    return pb.HypothesisSummary(
        hypothesis=summary.hypothesis,
        probability=summary.probability,
        current_area=summary.current_area,
        topological_path=summary.topological_path,
        areas=summary.areas,
        loop_closures=summary.loop_closures,
        arcs=summary.arcs,
    )


def _summary(message: pb.HypothesisSummary) -> HypothesisSummary:
    return HypothesisSummary(
        hypothesis=message.hypothesis,
        probability=message.probability,
        current_area=message.current_area,
        topological_path=tuple(message.topological_path),
        areas=message.areas,
        loop_closures=message.loop_closures,
        arcs=message.arcs,
    )


def _hypotheses_to_proto(hypotheses: Hypotheses) -> pb.Hypotheses:
    return pb.Hypotheses(
        stamp_s=hypotheses.stamp_s,
        revision=hypotheses.revision,
        hypotheses=map(_summary_to_proto, hypotheses.hypotheses),
    )


def _hypotheses(message: pb.Hypotheses) -> Hypotheses:
    known = tuple(map(_summary, message.hypotheses))
    return Hypotheses(message.stamp_s, message.revision, known)


def _posterior_to_proto(posterior: Posterior) -> pb.Posterior:
    return pb.Posterior(
        stamp_s=posterior.stamp_s,
        revision=posterior.revision,
        hypotheses=map(_summary_to_proto, posterior.hypotheses),
        current_area=dict(posterior.current_area),
        effective_sample_size=posterior.effective_sample_size,
    )


def _belief_to_proto(belief: Belief) -> pb.Belief:
    return pb.Belief(
        stamp_s=belief.stamp_s,
        current_area=dict(belief.current_area),
        effective_sample_size=belief.effective_sample_size,
        hypotheses=dict(belief.hypotheses),
    )


def _belief(message: pb.Belief) -> Belief:
    return Belief(
        stamp_s=message.stamp_s,
        current_area=dict(message.current_area),
        effective_sample_size=message.effective_sample_size,
        hypotheses=dict(message.hypotheses),
    )


def _posterior(message: pb.Posterior) -> Posterior:
    return Posterior(
        stamp_s=message.stamp_s,
        revision=message.revision,
        hypotheses=tuple(map(_summary, message.hypotheses)),
        current_area=dict(message.current_area),
        effective_sample_size=message.effective_sample_size,
    )


def _map_to_proto(global_map: GlobalMap) -> pb.GlobalMap:
    return pb.GlobalMap(
        method=f"MAP_METHOD_{global_map.method.name}",
        reference_area=global_map.reference_area,
        hypothesis=global_map.hypothesis,
        probability=global_map.probability,
        revision=global_map.revision,
        areas=map(_area_to_proto, global_map.areas),
        arcs=map(_arc_to_proto, global_map.arcs),
    )


def _map(message: pb.GlobalMap) -> GlobalMap:
    return GlobalMap(
        method=_enum(MapMethod, pb.MapMethod.Name(message.method), "MAP_METHOD_"),
        reference_area=message.reference_area,
        hypothesis=message.hypothesis,
        probability=message.probability,
        revision=message.revision,
        areas=tuple(map(_area, message.areas)),
        arcs=tuple(map(_arc, message.arcs)),
    )


def _area_to_proto(area: PlacedArea) -> pb.PlacedArea:
    return pb.PlacedArea(
        area=area.area,
        reference_from_area=_gaussian_to_proto(area.reference_from_area),
        keyframes=area.keyframes,
        visits=area.visits,
        points_in_area=np.asarray(area.points_in_area, dtype="<f4").tobytes(),
        version=area.version,
    )


def _area(message: pb.PlacedArea) -> PlacedArea:
    return PlacedArea(
        area=message.area,
        reference_from_area=_gaussian(message.reference_from_area),
        keyframes=message.keyframes,
        visits=message.visits,
        points_in_area=np.frombuffer(message.points_in_area, dtype="<f4").reshape(-1, 3),
        version=message.version,
    )


def _arc_to_proto(arc: Arc) -> pb.Arc:
    return pb.Arc(
        area_a=arc.area_a,
        area_b=arc.area_b,
        a_from_b=_gaussian_to_proto(arc.a_from_b),
        traversals=arc.traversals,
    )


def _arc(message: pb.Arc) -> Arc:
    return Arc(message.area_a, message.area_b, _gaussian(message.a_from_b), message.traversals)


def _area_details_to_proto(details: AreaDetails) -> pb.AreaDetails:
    return pb.AreaDetails(
        reference_area=details.reference_area,
        hypothesis=details.hypothesis,
        probability=details.probability,
        revision=details.revision,
        area=_area_to_proto(details.area),
        visits=[
            pb.AreaVisit(
                visit=visit.visit,
                area_from_visit=_transform_to_proto(visit.area_from_visit),
                last_stamp_s=visit.last_stamp_s,
                keyframes=visit.keyframes,
                is_forgotten=visit.is_forgotten,
            )
            for visit in details.visits
        ],
        arcs=map(_arc_to_proto, details.arcs),
    )


def _area_details(message: pb.AreaDetails) -> AreaDetails:
    return AreaDetails(
        reference_area=message.reference_area,
        hypothesis=message.hypothesis,
        probability=message.probability,
        revision=message.revision,
        area=_area(message.area),
        visits=tuple(
            AreaVisit(
                visit=visit.visit,
                area_from_visit=_transform(visit.area_from_visit),
                last_stamp_s=visit.last_stamp_s,
                keyframes=visit.keyframes,
                is_forgotten=visit.is_forgotten,
            )
            for visit in message.visits
        ),
        arcs=tuple(map(_arc, message.arcs)),
    )


def _trajectory_to_proto(trajectory: Trajectory) -> pb.Trajectory:
    poses = np.array([pose.reference_from_body for pose in trajectory.poses]).reshape(-1, 4, 4)
    return pb.Trajectory(
        reference_area=trajectory.reference_area,
        hypothesis=trajectory.hypothesis,
        probability=trajectory.probability,
        revision=trajectory.revision,
        is_smoothed=trajectory.is_smoothed,
        stamps_s=[pose.stamp_s for pose in trajectory.poses],
        reference_from_body=np.hstack([poses[:, :3, 3], quaternion_of(poses)]).ravel().tolist(),
    )


def _trajectory(message: pb.Trajectory) -> Trajectory:
    poses = np.array(message.reference_from_body, dtype=np.float64).reshape(-1, 7)
    return Trajectory(
        reference_area=message.reference_area,
        hypothesis=message.hypothesis,
        probability=message.probability,
        revision=message.revision,
        is_smoothed=message.is_smoothed,
        poses=tuple(
            StampedPose(stamp_s, pose_of(pose[3:], pose[:3]))
            for stamp_s, pose in zip(message.stamps_s, poses, strict=True)
        ),
    )


def _comparison_to_proto(comparison: Comparison) -> pb.Comparison:
    return pb.Comparison(
        reference_area=comparison.reference_area,
        hypothesis=comparison.hypothesis,
        revision=comparison.revision,
        areas=[
            pb.AreaDifference(
                area=area.area,
                translation_m=area.translation_m,
                rotation_rad=area.rotation_rad,
                sigma_consistent_m=area.sigma_consistent_m,
                sigma_shortest_path_m=area.sigma_shortest_path_m,
            )
            for area in comparison.areas
        ],
        arcs=[
            pb.ArcResidual(
                area_a=arc.area_a,
                area_b=arc.area_b,
                consistent_m=arc.consistent_m,
                shortest_path_m=arc.shortest_path_m,
            )
            for arc in comparison.arcs
        ],
    )


def _comparison(message: pb.Comparison) -> Comparison:
    return Comparison(
        reference_area=message.reference_area,
        hypothesis=message.hypothesis,
        revision=message.revision,
        areas=tuple(
            AreaDifference(
                area=area.area,
                translation_m=area.translation_m,
                rotation_rad=area.rotation_rad,
                sigma_consistent_m=area.sigma_consistent_m,
                sigma_shortest_path_m=area.sigma_shortest_path_m,
            )
            for area in message.areas
        ),
        arcs=tuple(
            ArcResidual(
                area_a=arc.area_a,
                area_b=arc.area_b,
                consistent_m=arc.consistent_m,
                shortest_path_m=arc.shortest_path_m,
            )
            for arc in message.arcs
        ),
    )


def _effect_to_proto(effect: StatementEffect) -> pb.StatementEffect:
    return pb.StatementEffect(
        statement=effect.statement,
        area_a=effect.area_a,
        area_b=effect.area_b,
        revision=effect.revision,
        hypotheses=[
            pb.HypothesisEffect(
                hypothesis=one.hypothesis,
                parent=one.parent,
                is_right=one.is_right,
                before=one.before,
                after=one.after,
                apart_m=one.apart_m,
                apart_rad=one.apart_rad,
                distance=one.distance,
            )
            for one in effect.hypotheses
        ],
    )


def _effect(message: pb.StatementEffect) -> StatementEffect:
    return StatementEffect(
        statement=message.statement,
        area_a=message.area_a,
        area_b=message.area_b,
        revision=message.revision,
        hypotheses=tuple(
            HypothesisEffect(
                hypothesis=one.hypothesis,
                parent=one.parent,
                is_right=one.is_right,
                before=one.before,
                after=one.after,
                apart_m=one.apart_m,
                apart_rad=one.apart_rad,
                distance=one.distance if one.HasField("distance") else None,
            )
            for one in message.hypotheses
        ),
    )


def _event_to_proto(event: Event) -> pb.Event:
    return pb.Event(
        kind=f"EVENT_KIND_{event.kind.name}",
        stamp_s=event.stamp_s,
        message=event.message,
        numbers=dict(event.numbers),
    )


def _event(message: pb.Event) -> Event:
    return Event(
        kind=_enum(EventKind, pb.EventKind.Name(message.kind), "EVENT_KIND_"),
        stamp_s=message.stamp_s,
        message=message.message,
        numbers=dict(message.numbers),
    )


def _status_to_proto(status: Status) -> pb.Status:
    counts = status.input
    return pb.Status(
        version=status.version,
        config_hash=status.config_hash,
        state=f"DAEMON_STATE_{status.state.name}",
        uptime_s=status.uptime_s,
        input=pb.InputCounts(
            received=counts.received,
            accepted=counts.accepted,
            refused=dict(counts.refused),
            queued=counts.queued,
            queued_bytes=counts.queued_bytes,
            discarded=counts.discarded,
            reordering=counts.reordering,
            dropped_beams=dict(counts.dropped_beams),
        ),
        tracked_scans=status.tracked_scans,
        processed_scans=status.processed_scans,
        processes=[
            pb.ProcessStatus(
                name=process.name,
                pid=process.pid,
                is_ready=process.is_ready,
                backlog=process.backlog,
                processed=process.processed,
                busy_s=process.busy_s,
                restarts=process.restarts,
            )
            for process in status.processes
        ],
        revision=status.revision,
        areas=status.areas,
        arcs=status.arcs,
        keyframes=status.keyframes,
        hypotheses=status.hypotheses,
        hypothesis=status.hypothesis,
        stored_keyframes=status.stored_keyframes,
        localization=(
            None if status.localization is None else _localization_to_proto(status.localization)
        ),
        senders=[
            pb.SenderCounts(
                sender=counts.sender,
                input=counts.input,
                received=counts.received,
                lost=counts.lost,
            )
            for counts in status.senders
        ],
        clock_s=status.clock_s,
    )


def _status(message: pb.Status) -> Status:
    counts = message.input
    return Status(
        version=message.version,
        config_hash=message.config_hash,
        state=_enum(DaemonState, pb.DaemonState.Name(message.state), "DAEMON_STATE_"),
        uptime_s=message.uptime_s,
        input=InputCounts(
            received=counts.received,
            accepted=counts.accepted,
            refused=dict(counts.refused),
            queued=counts.queued,
            queued_bytes=counts.queued_bytes,
            discarded=counts.discarded,
            reordering=counts.reordering,
            dropped_beams=dict(counts.dropped_beams),
        ),
        tracked_scans=message.tracked_scans,
        processed_scans=message.processed_scans,
        processes=tuple(
            ProcessStatus(
                name=ProcessName(process.name),
                pid=process.pid,
                is_ready=process.is_ready,
                backlog=process.backlog,
                processed=process.processed,
                busy_s=process.busy_s,
                restarts=process.restarts,
            )
            for process in message.processes
        ),
        revision=message.revision,
        areas=message.areas,
        arcs=message.arcs,
        keyframes=message.keyframes,
        hypotheses=message.hypotheses,
        hypothesis=message.hypothesis if message.HasField("hypothesis") else None,
        stored_keyframes=message.stored_keyframes,
        localization=(
            _localization(message.localization) if message.HasField("localization") else None
        ),
        senders=tuple(
            SenderCounts(counts.sender, Input(counts.input), counts.received, counts.lost)
            for counts in message.senders
        ),
        clock_s=message.clock_s,
    )


def _ack(message: pb.Ack) -> Ack:
    return Ack(
        received=message.received,
        accepted=message.accepted,
        refused=message.refused,
        processed_scans=message.processed_scans,
        files=tuple(message.files),
    )


def _error(message: pb.Error) -> HmtError:
    code = pb.ErrorCode.Name(message.code).removeprefix("ERROR_CODE_")
    return _FAILURES.get(code, DaemonFailure)(message.message)


def _enum(enum: type[E_], name: str, prefix: str) -> E_:
    try:
        return enum[name.removeprefix(prefix)]
    except KeyError as error:
        raise InvalidInput(f"{name} is not known here: the daemon is of another version") from error


_ENCODERS: dict[type, Callable[[Any], Message]] = {
    HmtPose: _pose_to_proto,
    Posterior: _posterior_to_proto,
    Hypotheses: _hypotheses_to_proto,
    History: lambda history: pb.History(
        revision=history.revision, beliefs=map(_belief_to_proto, history.beliefs)
    ),
    GlobalMap: _map_to_proto,
    AreaDetails: _area_details_to_proto,
    Trajectory: _trajectory_to_proto,
    Comparison: _comparison_to_proto,
    StatementEffect: _effect_to_proto,
    Event: _event_to_proto,
    tuple: lambda events: pb.Events(events=map(_event_to_proto, events)),
    Status: _status_to_proto,
    Ack: lambda ack: pb.Ack(
        received=ack.received,
        accepted=ack.accepted,
        refused=ack.refused,
        processed_scans=ack.processed_scans,
        files=ack.files,
    ),
}
_DECODERS: dict[str, tuple[type[Message], Callable[[Any], Value | HmtError]]] = {
    encoding_of(message): (message, from_proto)
    for message, from_proto in (
        (pb.HmtPose, _pose),
        (pb.Posterior, _posterior),
        (pb.Hypotheses, _hypotheses),
        (pb.GlobalMap, _map),
        (pb.AreaDetails, _area_details),
        (pb.Trajectory, _trajectory),
        (pb.Comparison, _comparison),
        (pb.StatementEffect, _effect),
        (pb.Event, _event),
        (pb.Events, lambda message: tuple(map(_event, message.events))),
        (
            pb.History,
            lambda message: History(message.revision, tuple(map(_belief, message.beliefs))),
        ),
        (pb.Status, _status),
        (pb.Ack, _ack),
        (pb.Error, _error),
    )
}
