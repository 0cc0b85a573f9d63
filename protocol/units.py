"""Quantities with their unit and bounds, as types: whoever decodes them need not check them again.

Every float is bounded on both sides, since that is what refuses NaN and infinity. The bounds are far
beyond any robot, and near enough that no sum, square or quotient of them overflows or vanishes.
"""

from typing import Annotated

from msgspec import Meta

Length = Annotated[float, Meta(ge=1e-3, le=1e6)]
"""m, positive"""
Coordinate = Annotated[float, Meta(ge=-1e7, le=1e7)]
"""m"""
Range = Annotated[float, Meta(ge=0.0, le=1e7)]
"""m, measured"""
Time = Annotated[float, Meta(ge=0.0, le=1e15)]
"""s"""
Duration = Annotated[float, Meta(ge=1e-6, le=1e6)]
"""s, positive"""
Clearance = Annotated[float, Meta(ge=0.0, le=1e6)]
"""m, or none"""
Speed = Annotated[float, Meta(ge=1e-6, le=1e6)]
"""m/s, positive"""
TurnRate = Annotated[float, Meta(ge=1e-6, le=1e6)]
"""rad/s, positive"""
Velocity = Annotated[float, Meta(ge=-1e8, le=1e8)]
"""m/s: a Speed, and whatever noise adds to it"""
AngularVelocity = Annotated[float, Meta(ge=-1e8, le=1e8)]
"""rad/s: a TurnRate, and whatever noise adds to it"""
Angle = Annotated[float, Meta(ge=-1e9, le=1e9)]
"""rad, not wrapped"""
Sigma = Annotated[float, Meta(ge=0.0, le=1e4)]
"""m, a standard deviation"""
Moment = Annotated[float, Meta(ge=-1e15, le=1e15)]
"""of second order, of m and rad"""
Finite = Annotated[float, Meta(ge=-1e18, le=1e18)]
"""a number of a user's own, such as a count of an encoder or a time"""
Probability = Annotated[float, Meta(ge=0.0, le=0.5)]
Fraction = Annotated[float, Meta(ge=0.0, le=0.5)]
Tick = Annotated[int, Meta(ge=0, le=2**31)]
TickCount = Annotated[int, Meta(ge=1, le=2**31)]
Count = Annotated[int, Meta(ge=0, le=2**53)]
NAME = r"\A[A-Za-z0-9][A-Za-z0-9_-]{0,63}\Z"
"""of a robot, a run, a scenario: one chunk of a key expression, part of a file's name, never an option"""
MAX_ROBOT_ID = 32
"""characters"""
RobotId = Annotated[str, Meta(pattern=NAME, max_length=MAX_ROBOT_ID)]
