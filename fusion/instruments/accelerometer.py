"""Accelerometers, uni- and triaxial, and gyroscopes: what rides on the body and senses its motion against inertia.

The axes of a triaxial one are channels with the same `common` name: they share a chain and its errors.
"""

from fusion.instruments.transducer import Transducer

ACCELERATION = Transducer("acceleration", "m/s^2", "accelerometer", order=0, weighs=True)
ANGULAR_VELOCITY = Transducer("angular_velocity", "rad/s", "accelerometer", order=-1, turning=True)
