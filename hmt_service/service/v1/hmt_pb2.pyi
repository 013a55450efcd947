from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class MapMethod(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    MAP_METHOD_UNSPECIFIED: _ClassVar[MapMethod]
    MAP_METHOD_CONSISTENT: _ClassVar[MapMethod]
    MAP_METHOD_SHORTEST_PATH: _ClassVar[MapMethod]

class EventKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    EVENT_KIND_UNSPECIFIED: _ClassVar[EventKind]
    EVENT_KIND_AREA_ENTERED: _ClassVar[EventKind]
    EVENT_KIND_BRANCHED: _ClassVar[EventKind]
    EVENT_KIND_PRUNED: _ClassVar[EventKind]
    EVENT_KIND_ACCEPTED: _ClassVar[EventKind]
    EVENT_KIND_INPUT_DROPPED: _ClassVar[EventKind]
    EVENT_KIND_LOST: _ClassVar[EventKind]
    EVENT_KIND_PROCESS_FAILED: _ClassVar[EventKind]
    EVENT_KIND_PRESET_DOUBTED: _ClassVar[EventKind]
    EVENT_KIND_PRESET_CONFIRMED: _ClassVar[EventKind]
    EVENT_KIND_NOT_SAVED: _ClassVar[EventKind]
    EVENT_KIND_OVER_BUDGET: _ClassVar[EventKind]
    EVENT_KIND_PROCESS_RESTARTED: _ClassVar[EventKind]
    EVENT_KIND_ARC_ASSERTED: _ClassVar[EventKind]
    EVENT_KIND_ARC_RETRACTED: _ClassVar[EventKind]

class DaemonState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DAEMON_STATE_UNSPECIFIED: _ClassVar[DaemonState]
    DAEMON_STATE_STARTING: _ClassVar[DaemonState]
    DAEMON_STATE_RUNNING: _ClassVar[DaemonState]
    DAEMON_STATE_STOPPING: _ClassVar[DaemonState]

class ErrorCode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ERROR_CODE_UNSPECIFIED: _ClassVar[ErrorCode]
    ERROR_CODE_INVALID_ARGUMENT: _ClassVar[ErrorCode]
    ERROR_CODE_NOT_FOUND: _ClassVar[ErrorCode]
    ERROR_CODE_UNAVAILABLE: _ClassVar[ErrorCode]
    ERROR_CODE_DEADLINE_EXCEEDED: _ClassVar[ErrorCode]
    ERROR_CODE_INTERNAL: _ClassVar[ErrorCode]
MAP_METHOD_UNSPECIFIED: MapMethod
MAP_METHOD_CONSISTENT: MapMethod
MAP_METHOD_SHORTEST_PATH: MapMethod
EVENT_KIND_UNSPECIFIED: EventKind
EVENT_KIND_AREA_ENTERED: EventKind
EVENT_KIND_BRANCHED: EventKind
EVENT_KIND_PRUNED: EventKind
EVENT_KIND_ACCEPTED: EventKind
EVENT_KIND_INPUT_DROPPED: EventKind
EVENT_KIND_LOST: EventKind
EVENT_KIND_PROCESS_FAILED: EventKind
EVENT_KIND_PRESET_DOUBTED: EventKind
EVENT_KIND_PRESET_CONFIRMED: EventKind
EVENT_KIND_NOT_SAVED: EventKind
EVENT_KIND_OVER_BUDGET: EventKind
EVENT_KIND_PROCESS_RESTARTED: EventKind
EVENT_KIND_ARC_ASSERTED: EventKind
EVENT_KIND_ARC_RETRACTED: EventKind
DAEMON_STATE_UNSPECIFIED: DaemonState
DAEMON_STATE_STARTING: DaemonState
DAEMON_STATE_RUNNING: DaemonState
DAEMON_STATE_STOPPING: DaemonState
ERROR_CODE_UNSPECIFIED: ErrorCode
ERROR_CODE_INVALID_ARGUMENT: ErrorCode
ERROR_CODE_NOT_FOUND: ErrorCode
ERROR_CODE_UNAVAILABLE: ErrorCode
ERROR_CODE_DEADLINE_EXCEEDED: ErrorCode
ERROR_CODE_INTERNAL: ErrorCode

class GaussianPose(_message.Message):
    __slots__ = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "covariance")
    X_M_FIELD_NUMBER: _ClassVar[int]
    Y_M_FIELD_NUMBER: _ClassVar[int]
    Z_M_FIELD_NUMBER: _ClassVar[int]
    QX_FIELD_NUMBER: _ClassVar[int]
    QY_FIELD_NUMBER: _ClassVar[int]
    QZ_FIELD_NUMBER: _ClassVar[int]
    QW_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    x_m: float
    y_m: float
    z_m: float
    qx: float
    qy: float
    qz: float
    qw: float
    covariance: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, x_m: _Optional[float] = ..., y_m: _Optional[float] = ..., z_m: _Optional[float] = ..., qx: _Optional[float] = ..., qy: _Optional[float] = ..., qz: _Optional[float] = ..., qw: _Optional[float] = ..., covariance: _Optional[_Iterable[float]] = ...) -> None: ...

class Localization(_message.Message):
    __slots__ = ("stamp_s", "probability", "entropy_nat", "evidence_stamp_s")
    STAMP_S_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    ENTROPY_NAT_FIELD_NUMBER: _ClassVar[int]
    EVIDENCE_STAMP_S_FIELD_NUMBER: _ClassVar[int]
    stamp_s: float
    probability: float
    entropy_nat: float
    evidence_stamp_s: float
    def __init__(self, stamp_s: _Optional[float] = ..., probability: _Optional[float] = ..., entropy_nat: _Optional[float] = ..., evidence_stamp_s: _Optional[float] = ...) -> None: ...

class HmtPose(_message.Message):
    __slots__ = ("stamp_s", "area", "area_from_body", "reference_area", "reference_from_body", "hypothesis", "probability", "revision", "localization")
    STAMP_S_FIELD_NUMBER: _ClassVar[int]
    AREA_FIELD_NUMBER: _ClassVar[int]
    AREA_FROM_BODY_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_AREA_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_FROM_BODY_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESIS_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    LOCALIZATION_FIELD_NUMBER: _ClassVar[int]
    stamp_s: float
    area: int
    area_from_body: GaussianPose
    reference_area: int
    reference_from_body: GaussianPose
    hypothesis: int
    probability: float
    revision: int
    localization: Localization
    def __init__(self, stamp_s: _Optional[float] = ..., area: _Optional[int] = ..., area_from_body: _Optional[_Union[GaussianPose, _Mapping]] = ..., reference_area: _Optional[int] = ..., reference_from_body: _Optional[_Union[GaussianPose, _Mapping]] = ..., hypothesis: _Optional[int] = ..., probability: _Optional[float] = ..., revision: _Optional[int] = ..., localization: _Optional[_Union[Localization, _Mapping]] = ...) -> None: ...

class HypothesisSummary(_message.Message):
    __slots__ = ("hypothesis", "probability", "current_area", "topological_path", "areas", "loop_closures", "arcs")
    HYPOTHESIS_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    CURRENT_AREA_FIELD_NUMBER: _ClassVar[int]
    TOPOLOGICAL_PATH_FIELD_NUMBER: _ClassVar[int]
    AREAS_FIELD_NUMBER: _ClassVar[int]
    LOOP_CLOSURES_FIELD_NUMBER: _ClassVar[int]
    ARCS_FIELD_NUMBER: _ClassVar[int]
    hypothesis: int
    probability: float
    current_area: int
    topological_path: _containers.RepeatedScalarFieldContainer[int]
    areas: int
    loop_closures: int
    arcs: int
    def __init__(self, hypothesis: _Optional[int] = ..., probability: _Optional[float] = ..., current_area: _Optional[int] = ..., topological_path: _Optional[_Iterable[int]] = ..., areas: _Optional[int] = ..., loop_closures: _Optional[int] = ..., arcs: _Optional[int] = ...) -> None: ...

class Hypotheses(_message.Message):
    __slots__ = ("stamp_s", "revision", "hypotheses")
    STAMP_S_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESES_FIELD_NUMBER: _ClassVar[int]
    stamp_s: float
    revision: int
    hypotheses: _containers.RepeatedCompositeFieldContainer[HypothesisSummary]
    def __init__(self, stamp_s: _Optional[float] = ..., revision: _Optional[int] = ..., hypotheses: _Optional[_Iterable[_Union[HypothesisSummary, _Mapping]]] = ...) -> None: ...

class Posterior(_message.Message):
    __slots__ = ("stamp_s", "revision", "hypotheses", "current_area", "effective_sample_size")
    class CurrentAreaEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: int
        value: float
        def __init__(self, key: _Optional[int] = ..., value: _Optional[float] = ...) -> None: ...
    STAMP_S_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESES_FIELD_NUMBER: _ClassVar[int]
    CURRENT_AREA_FIELD_NUMBER: _ClassVar[int]
    EFFECTIVE_SAMPLE_SIZE_FIELD_NUMBER: _ClassVar[int]
    stamp_s: float
    revision: int
    hypotheses: _containers.RepeatedCompositeFieldContainer[HypothesisSummary]
    current_area: _containers.ScalarMap[int, float]
    effective_sample_size: float
    def __init__(self, stamp_s: _Optional[float] = ..., revision: _Optional[int] = ..., hypotheses: _Optional[_Iterable[_Union[HypothesisSummary, _Mapping]]] = ..., current_area: _Optional[_Mapping[int, float]] = ..., effective_sample_size: _Optional[float] = ...) -> None: ...

class PlacedArea(_message.Message):
    __slots__ = ("area", "reference_from_area", "keyframes", "visits", "points_in_area", "version")
    AREA_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_FROM_AREA_FIELD_NUMBER: _ClassVar[int]
    KEYFRAMES_FIELD_NUMBER: _ClassVar[int]
    VISITS_FIELD_NUMBER: _ClassVar[int]
    POINTS_IN_AREA_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    area: int
    reference_from_area: GaussianPose
    keyframes: int
    visits: int
    points_in_area: bytes
    version: int
    def __init__(self, area: _Optional[int] = ..., reference_from_area: _Optional[_Union[GaussianPose, _Mapping]] = ..., keyframes: _Optional[int] = ..., visits: _Optional[int] = ..., points_in_area: _Optional[bytes] = ..., version: _Optional[int] = ...) -> None: ...

class Arc(_message.Message):
    __slots__ = ("area_a", "area_b", "a_from_b", "traversals")
    AREA_A_FIELD_NUMBER: _ClassVar[int]
    AREA_B_FIELD_NUMBER: _ClassVar[int]
    A_FROM_B_FIELD_NUMBER: _ClassVar[int]
    TRAVERSALS_FIELD_NUMBER: _ClassVar[int]
    area_a: int
    area_b: int
    a_from_b: GaussianPose
    traversals: int
    def __init__(self, area_a: _Optional[int] = ..., area_b: _Optional[int] = ..., a_from_b: _Optional[_Union[GaussianPose, _Mapping]] = ..., traversals: _Optional[int] = ...) -> None: ...

class GlobalMap(_message.Message):
    __slots__ = ("method", "reference_area", "hypothesis", "probability", "revision", "areas", "arcs")
    METHOD_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_AREA_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESIS_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    AREAS_FIELD_NUMBER: _ClassVar[int]
    ARCS_FIELD_NUMBER: _ClassVar[int]
    method: MapMethod
    reference_area: int
    hypothesis: int
    probability: float
    revision: int
    areas: _containers.RepeatedCompositeFieldContainer[PlacedArea]
    arcs: _containers.RepeatedCompositeFieldContainer[Arc]
    def __init__(self, method: _Optional[_Union[MapMethod, str]] = ..., reference_area: _Optional[int] = ..., hypothesis: _Optional[int] = ..., probability: _Optional[float] = ..., revision: _Optional[int] = ..., areas: _Optional[_Iterable[_Union[PlacedArea, _Mapping]]] = ..., arcs: _Optional[_Iterable[_Union[Arc, _Mapping]]] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    X_M_FIELD_NUMBER: _ClassVar[int]
    Y_M_FIELD_NUMBER: _ClassVar[int]
    Z_M_FIELD_NUMBER: _ClassVar[int]
    QX_FIELD_NUMBER: _ClassVar[int]
    QY_FIELD_NUMBER: _ClassVar[int]
    QZ_FIELD_NUMBER: _ClassVar[int]
    QW_FIELD_NUMBER: _ClassVar[int]
    x_m: float
    y_m: float
    z_m: float
    qx: float
    qy: float
    qz: float
    qw: float
    def __init__(self, x_m: _Optional[float] = ..., y_m: _Optional[float] = ..., z_m: _Optional[float] = ..., qx: _Optional[float] = ..., qy: _Optional[float] = ..., qz: _Optional[float] = ..., qw: _Optional[float] = ...) -> None: ...

class AreaVisit(_message.Message):
    __slots__ = ("visit", "area_from_visit", "last_stamp_s", "keyframes", "is_forgotten")
    VISIT_FIELD_NUMBER: _ClassVar[int]
    AREA_FROM_VISIT_FIELD_NUMBER: _ClassVar[int]
    LAST_STAMP_S_FIELD_NUMBER: _ClassVar[int]
    KEYFRAMES_FIELD_NUMBER: _ClassVar[int]
    IS_FORGOTTEN_FIELD_NUMBER: _ClassVar[int]
    visit: int
    area_from_visit: Pose
    last_stamp_s: float
    keyframes: int
    is_forgotten: bool
    def __init__(self, visit: _Optional[int] = ..., area_from_visit: _Optional[_Union[Pose, _Mapping]] = ..., last_stamp_s: _Optional[float] = ..., keyframes: _Optional[int] = ..., is_forgotten: _Optional[bool] = ...) -> None: ...

class AreaDetails(_message.Message):
    __slots__ = ("reference_area", "hypothesis", "probability", "revision", "area", "visits", "arcs")
    REFERENCE_AREA_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESIS_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    AREA_FIELD_NUMBER: _ClassVar[int]
    VISITS_FIELD_NUMBER: _ClassVar[int]
    ARCS_FIELD_NUMBER: _ClassVar[int]
    reference_area: int
    hypothesis: int
    probability: float
    revision: int
    area: PlacedArea
    visits: _containers.RepeatedCompositeFieldContainer[AreaVisit]
    arcs: _containers.RepeatedCompositeFieldContainer[Arc]
    def __init__(self, reference_area: _Optional[int] = ..., hypothesis: _Optional[int] = ..., probability: _Optional[float] = ..., revision: _Optional[int] = ..., area: _Optional[_Union[PlacedArea, _Mapping]] = ..., visits: _Optional[_Iterable[_Union[AreaVisit, _Mapping]]] = ..., arcs: _Optional[_Iterable[_Union[Arc, _Mapping]]] = ...) -> None: ...

class Trajectory(_message.Message):
    __slots__ = ("reference_area", "hypothesis", "probability", "revision", "is_smoothed", "stamps_s", "reference_from_body")
    REFERENCE_AREA_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESIS_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    IS_SMOOTHED_FIELD_NUMBER: _ClassVar[int]
    STAMPS_S_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_FROM_BODY_FIELD_NUMBER: _ClassVar[int]
    reference_area: int
    hypothesis: int
    probability: float
    revision: int
    is_smoothed: bool
    stamps_s: _containers.RepeatedScalarFieldContainer[float]
    reference_from_body: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, reference_area: _Optional[int] = ..., hypothesis: _Optional[int] = ..., probability: _Optional[float] = ..., revision: _Optional[int] = ..., is_smoothed: _Optional[bool] = ..., stamps_s: _Optional[_Iterable[float]] = ..., reference_from_body: _Optional[_Iterable[float]] = ...) -> None: ...

class AreaDifference(_message.Message):
    __slots__ = ("area", "translation_m", "rotation_rad", "sigma_consistent_m", "sigma_shortest_path_m")
    AREA_FIELD_NUMBER: _ClassVar[int]
    TRANSLATION_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_RAD_FIELD_NUMBER: _ClassVar[int]
    SIGMA_CONSISTENT_M_FIELD_NUMBER: _ClassVar[int]
    SIGMA_SHORTEST_PATH_M_FIELD_NUMBER: _ClassVar[int]
    area: int
    translation_m: float
    rotation_rad: float
    sigma_consistent_m: float
    sigma_shortest_path_m: float
    def __init__(self, area: _Optional[int] = ..., translation_m: _Optional[float] = ..., rotation_rad: _Optional[float] = ..., sigma_consistent_m: _Optional[float] = ..., sigma_shortest_path_m: _Optional[float] = ...) -> None: ...

class ArcResidual(_message.Message):
    __slots__ = ("area_a", "area_b", "consistent_m", "shortest_path_m")
    AREA_A_FIELD_NUMBER: _ClassVar[int]
    AREA_B_FIELD_NUMBER: _ClassVar[int]
    CONSISTENT_M_FIELD_NUMBER: _ClassVar[int]
    SHORTEST_PATH_M_FIELD_NUMBER: _ClassVar[int]
    area_a: int
    area_b: int
    consistent_m: float
    shortest_path_m: float
    def __init__(self, area_a: _Optional[int] = ..., area_b: _Optional[int] = ..., consistent_m: _Optional[float] = ..., shortest_path_m: _Optional[float] = ...) -> None: ...

class Comparison(_message.Message):
    __slots__ = ("reference_area", "hypothesis", "revision", "areas", "arcs")
    REFERENCE_AREA_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESIS_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    AREAS_FIELD_NUMBER: _ClassVar[int]
    ARCS_FIELD_NUMBER: _ClassVar[int]
    reference_area: int
    hypothesis: int
    revision: int
    areas: _containers.RepeatedCompositeFieldContainer[AreaDifference]
    arcs: _containers.RepeatedCompositeFieldContainer[ArcResidual]
    def __init__(self, reference_area: _Optional[int] = ..., hypothesis: _Optional[int] = ..., revision: _Optional[int] = ..., areas: _Optional[_Iterable[_Union[AreaDifference, _Mapping]]] = ..., arcs: _Optional[_Iterable[_Union[ArcResidual, _Mapping]]] = ...) -> None: ...

class HypothesisEffect(_message.Message):
    __slots__ = ("hypothesis", "parent", "is_right", "before", "after", "apart_m", "apart_rad", "distance")
    HYPOTHESIS_FIELD_NUMBER: _ClassVar[int]
    PARENT_FIELD_NUMBER: _ClassVar[int]
    IS_RIGHT_FIELD_NUMBER: _ClassVar[int]
    BEFORE_FIELD_NUMBER: _ClassVar[int]
    AFTER_FIELD_NUMBER: _ClassVar[int]
    APART_M_FIELD_NUMBER: _ClassVar[int]
    APART_RAD_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_FIELD_NUMBER: _ClassVar[int]
    hypothesis: int
    parent: int
    is_right: bool
    before: float
    after: float
    apart_m: float
    apart_rad: float
    distance: float
    def __init__(self, hypothesis: _Optional[int] = ..., parent: _Optional[int] = ..., is_right: _Optional[bool] = ..., before: _Optional[float] = ..., after: _Optional[float] = ..., apart_m: _Optional[float] = ..., apart_rad: _Optional[float] = ..., distance: _Optional[float] = ...) -> None: ...

class StatementEffect(_message.Message):
    __slots__ = ("statement", "area_a", "area_b", "revision", "hypotheses")
    STATEMENT_FIELD_NUMBER: _ClassVar[int]
    AREA_A_FIELD_NUMBER: _ClassVar[int]
    AREA_B_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESES_FIELD_NUMBER: _ClassVar[int]
    statement: int
    area_a: int
    area_b: int
    revision: int
    hypotheses: _containers.RepeatedCompositeFieldContainer[HypothesisEffect]
    def __init__(self, statement: _Optional[int] = ..., area_a: _Optional[int] = ..., area_b: _Optional[int] = ..., revision: _Optional[int] = ..., hypotheses: _Optional[_Iterable[_Union[HypothesisEffect, _Mapping]]] = ...) -> None: ...

class Event(_message.Message):
    __slots__ = ("kind", "stamp_s", "message", "numbers")
    class NumbersEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    KIND_FIELD_NUMBER: _ClassVar[int]
    STAMP_S_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    NUMBERS_FIELD_NUMBER: _ClassVar[int]
    kind: EventKind
    stamp_s: float
    message: str
    numbers: _containers.ScalarMap[str, float]
    def __init__(self, kind: _Optional[_Union[EventKind, str]] = ..., stamp_s: _Optional[float] = ..., message: _Optional[str] = ..., numbers: _Optional[_Mapping[str, float]] = ...) -> None: ...

class Events(_message.Message):
    __slots__ = ("events",)
    EVENTS_FIELD_NUMBER: _ClassVar[int]
    events: _containers.RepeatedCompositeFieldContainer[Event]
    def __init__(self, events: _Optional[_Iterable[_Union[Event, _Mapping]]] = ...) -> None: ...

class Belief(_message.Message):
    __slots__ = ("stamp_s", "current_area", "effective_sample_size", "hypotheses")
    class CurrentAreaEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: int
        value: float
        def __init__(self, key: _Optional[int] = ..., value: _Optional[float] = ...) -> None: ...
    class HypothesesEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: int
        value: float
        def __init__(self, key: _Optional[int] = ..., value: _Optional[float] = ...) -> None: ...
    STAMP_S_FIELD_NUMBER: _ClassVar[int]
    CURRENT_AREA_FIELD_NUMBER: _ClassVar[int]
    EFFECTIVE_SAMPLE_SIZE_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESES_FIELD_NUMBER: _ClassVar[int]
    stamp_s: float
    current_area: _containers.ScalarMap[int, float]
    effective_sample_size: float
    hypotheses: _containers.ScalarMap[int, float]
    def __init__(self, stamp_s: _Optional[float] = ..., current_area: _Optional[_Mapping[int, float]] = ..., effective_sample_size: _Optional[float] = ..., hypotheses: _Optional[_Mapping[int, float]] = ...) -> None: ...

class History(_message.Message):
    __slots__ = ("beliefs", "revision")
    BELIEFS_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    beliefs: _containers.RepeatedCompositeFieldContainer[Belief]
    revision: int
    def __init__(self, beliefs: _Optional[_Iterable[_Union[Belief, _Mapping]]] = ..., revision: _Optional[int] = ...) -> None: ...

class ProcessStatus(_message.Message):
    __slots__ = ("name", "pid", "is_ready", "backlog", "processed", "busy_s", "restarts")
    NAME_FIELD_NUMBER: _ClassVar[int]
    PID_FIELD_NUMBER: _ClassVar[int]
    IS_READY_FIELD_NUMBER: _ClassVar[int]
    BACKLOG_FIELD_NUMBER: _ClassVar[int]
    PROCESSED_FIELD_NUMBER: _ClassVar[int]
    BUSY_S_FIELD_NUMBER: _ClassVar[int]
    RESTARTS_FIELD_NUMBER: _ClassVar[int]
    name: str
    pid: int
    is_ready: bool
    backlog: int
    processed: int
    busy_s: float
    restarts: int
    def __init__(self, name: _Optional[str] = ..., pid: _Optional[int] = ..., is_ready: _Optional[bool] = ..., backlog: _Optional[int] = ..., processed: _Optional[int] = ..., busy_s: _Optional[float] = ..., restarts: _Optional[int] = ...) -> None: ...

class InputCounts(_message.Message):
    __slots__ = ("received", "accepted", "refused", "queued", "queued_bytes", "discarded", "reordering", "dropped_beams")
    class RefusedEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    class DroppedBeamsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    RECEIVED_FIELD_NUMBER: _ClassVar[int]
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    QUEUED_FIELD_NUMBER: _ClassVar[int]
    QUEUED_BYTES_FIELD_NUMBER: _ClassVar[int]
    DISCARDED_FIELD_NUMBER: _ClassVar[int]
    REORDERING_FIELD_NUMBER: _ClassVar[int]
    DROPPED_BEAMS_FIELD_NUMBER: _ClassVar[int]
    received: int
    accepted: int
    refused: _containers.ScalarMap[str, int]
    queued: int
    queued_bytes: int
    discarded: int
    reordering: int
    dropped_beams: _containers.ScalarMap[str, int]
    def __init__(self, received: _Optional[int] = ..., accepted: _Optional[int] = ..., refused: _Optional[_Mapping[str, int]] = ..., queued: _Optional[int] = ..., queued_bytes: _Optional[int] = ..., discarded: _Optional[int] = ..., reordering: _Optional[int] = ..., dropped_beams: _Optional[_Mapping[str, int]] = ...) -> None: ...

class Origin(_message.Message):
    __slots__ = ("sender", "number")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    sender: int
    number: int
    def __init__(self, sender: _Optional[int] = ..., number: _Optional[int] = ...) -> None: ...

class SenderCounts(_message.Message):
    __slots__ = ("sender", "input", "received", "lost")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    INPUT_FIELD_NUMBER: _ClassVar[int]
    RECEIVED_FIELD_NUMBER: _ClassVar[int]
    LOST_FIELD_NUMBER: _ClassVar[int]
    sender: int
    input: str
    received: int
    lost: int
    def __init__(self, sender: _Optional[int] = ..., input: _Optional[str] = ..., received: _Optional[int] = ..., lost: _Optional[int] = ...) -> None: ...

class Status(_message.Message):
    __slots__ = ("version", "config_hash", "state", "uptime_s", "input", "tracked_scans", "processed_scans", "processes", "revision", "areas", "arcs", "keyframes", "hypotheses", "stored_keyframes", "localization", "hypothesis", "senders", "clock_s")
    VERSION_FIELD_NUMBER: _ClassVar[int]
    CONFIG_HASH_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    UPTIME_S_FIELD_NUMBER: _ClassVar[int]
    INPUT_FIELD_NUMBER: _ClassVar[int]
    TRACKED_SCANS_FIELD_NUMBER: _ClassVar[int]
    PROCESSED_SCANS_FIELD_NUMBER: _ClassVar[int]
    PROCESSES_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    AREAS_FIELD_NUMBER: _ClassVar[int]
    ARCS_FIELD_NUMBER: _ClassVar[int]
    KEYFRAMES_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESES_FIELD_NUMBER: _ClassVar[int]
    STORED_KEYFRAMES_FIELD_NUMBER: _ClassVar[int]
    LOCALIZATION_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESIS_FIELD_NUMBER: _ClassVar[int]
    SENDERS_FIELD_NUMBER: _ClassVar[int]
    CLOCK_S_FIELD_NUMBER: _ClassVar[int]
    version: str
    config_hash: str
    state: DaemonState
    uptime_s: float
    input: InputCounts
    tracked_scans: int
    processed_scans: int
    processes: _containers.RepeatedCompositeFieldContainer[ProcessStatus]
    revision: int
    areas: int
    arcs: int
    keyframes: int
    hypotheses: int
    stored_keyframes: int
    localization: Localization
    hypothesis: int
    senders: _containers.RepeatedCompositeFieldContainer[SenderCounts]
    clock_s: float
    def __init__(self, version: _Optional[str] = ..., config_hash: _Optional[str] = ..., state: _Optional[_Union[DaemonState, str]] = ..., uptime_s: _Optional[float] = ..., input: _Optional[_Union[InputCounts, _Mapping]] = ..., tracked_scans: _Optional[int] = ..., processed_scans: _Optional[int] = ..., processes: _Optional[_Iterable[_Union[ProcessStatus, _Mapping]]] = ..., revision: _Optional[int] = ..., areas: _Optional[int] = ..., arcs: _Optional[int] = ..., keyframes: _Optional[int] = ..., hypotheses: _Optional[int] = ..., stored_keyframes: _Optional[int] = ..., localization: _Optional[_Union[Localization, _Mapping]] = ..., hypothesis: _Optional[int] = ..., senders: _Optional[_Iterable[_Union[SenderCounts, _Mapping]]] = ..., clock_s: _Optional[float] = ...) -> None: ...

class Ack(_message.Message):
    __slots__ = ("received", "accepted", "refused", "processed_scans", "files")
    RECEIVED_FIELD_NUMBER: _ClassVar[int]
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    PROCESSED_SCANS_FIELD_NUMBER: _ClassVar[int]
    FILES_FIELD_NUMBER: _ClassVar[int]
    received: int
    accepted: int
    refused: int
    processed_scans: int
    files: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, received: _Optional[int] = ..., accepted: _Optional[int] = ..., refused: _Optional[int] = ..., processed_scans: _Optional[int] = ..., files: _Optional[_Iterable[str]] = ...) -> None: ...

class Part(_message.Message):
    __slots__ = ("number", "count")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    number: int
    count: int
    def __init__(self, number: _Optional[int] = ..., count: _Optional[int] = ...) -> None: ...

class Error(_message.Message):
    __slots__ = ("code", "message")
    CODE_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    code: ErrorCode
    message: str
    def __init__(self, code: _Optional[_Union[ErrorCode, str]] = ..., message: _Optional[str] = ...) -> None: ...
