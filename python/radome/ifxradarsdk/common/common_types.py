"""Kinds of sensors."""

from enum import IntEnum


class RadarSensor(IntEnum):
    """Sensors that a script may ask for. radome drives the BGT60TR13C alone."""

    BGT60TR13C = 0
    Unknown_sensor = 4095

    def __str__(self) -> str:
        return f"RadarSensor.{self.name}"


__all__ = ["RadarSensor"]
