"""Types of quantities with their units and bounds, which are checked when a message or file is decoded.

All floats have bounds on both sides, which excludes NaN and infinity. The bounds are far beyond those of any
robot, but small enough that no sum, square or quotient of two quantities overflows or underflows.
"""

from typing import Annotated

from msgspec import Meta

Length = Annotated[float, Meta(ge=1e-3, le=1e6)]
"""A positive length, in m."""
Coordinate = Annotated[float, Meta(ge=-1e7, le=1e7)]
"""A coordinate, in m."""
Range = Annotated[float, Meta(ge=0.0, le=1e7)]
"""A measured distance, in m."""
Time = Annotated[float, Meta(ge=0.0, le=1e15)]
"""A time, in s."""
Duration = Annotated[float, Meta(ge=1e-6, le=1e6)]
"""A positive duration, in s."""
Clearance = Annotated[float, Meta(ge=0.0, le=1e6)]
"""A length, in m; 0 for none."""
Speed = Annotated[float, Meta(ge=1e-6, le=1e6)]
"""A positive speed, in m/s."""
TurnRate = Annotated[float, Meta(ge=1e-6, le=1e6)]
"""A positive turn rate, in rad/s."""
Velocity = Annotated[float, Meta(ge=-1e8, le=1e8)]
"""A signed velocity, in m/s. Its bounds are those of Speed with room for noise."""
AngularVelocity = Annotated[float, Meta(ge=-1e8, le=1e8)]
"""A signed angular velocity, in rad/s. Its bounds are those of TurnRate with room for noise."""
Angle = Annotated[float, Meta(ge=-1e9, le=1e9)]
"""An angle, in rad, not wrapped."""
Sigma = Annotated[float, Meta(ge=0.0, le=1e4)]
"""A standard deviation, in m."""
Moment = Annotated[float, Meta(ge=-1e15, le=1e15)]
"""An element of a covariance matrix, in m^2, m rad or rad^2."""
Finite = Annotated[float, Meta(ge=-1e18, le=1e18)]
"""A number defined by the user, such as an encoder count or a time."""
Integer = Annotated[int, Meta(ge=-(2**53), le=2**53)]
"""An integer defined by the user."""
Probability = Annotated[float, Meta(ge=0.0, le=0.5)]
"""The probability of an outlier or drop-out."""
Fraction = Annotated[float, Meta(ge=0.0, le=0.5)]
"""A standard deviation, as a fraction of the value."""
Tick = Annotated[int, Meta(ge=0, le=2**31)]
"""The number k of a tick, which begins at k T_s."""
TickCount = Annotated[int, Meta(ge=1, le=2**31)]
"""A positive number of ticks."""
Count = Annotated[int, Meta(ge=0, le=2**53)]
"""A number of things."""
NAME = r"\A[A-Za-z0-9][A-Za-z0-9_-]{0,63}\Z"
"""The pattern of the name of a robot, run or scenario.

A name is a single chunk of a Zenoh key expression and part of file names. It never looks like an option.
"""
MAX_ROBOT_ID = 32
"""The maximum number of characters of a robot's name."""
RobotId = Annotated[str, Meta(pattern=NAME, max_length=MAX_ROBOT_ID)]
"""The name of a robot."""
