"""A Webots controller that puts its robot on a TCP port, in the deployed dialect of WC2EC, for `zbridge run`.

Needs nothing but Python and Webots' own `controller` module. In the simulation: controller "zbridge_controller",
controllerArgs ["27015"] (one port per robot; 27015 without arguments). It serves one gateway at a time. When the
gateway disconnects, it stops the motors and listens again. See README.md beside this file.
"""

import math
import socket
import struct
import sys

from controller import DistanceSensor, Motor, Node, Robot

PORT = 27015
STEP_MS = 20
NAME_BYTES = 255
REGISTER, DATA, SET_VALUE = 0, 1, 130
COMMAND_BYTES = 11


class Bridge:
    """One robot's devices, and the connected gateway, if any."""

    def __init__(self, robot, port):
        self.robot = robot
        self.devices = [robot.getDeviceByIndex(index) for index in range(min(robot.getNumberOfDevices(), 255))]
        self.sensors = [(i, d) for i, d in enumerate(self.devices) if isinstance(d, DistanceSensor)]
        self.motors = {i: d for i, d in enumerate(self.devices) if isinstance(d, Motor)}
        for _, sensor in self.sensors:
            sensor.enable(STEP_MS)
        self.server = socket.create_server(("", port))
        self.server.setblocking(False)
        self.gateway = None
        self.received = b""
        self.unsent = b""
        self.stop()

    def stop(self):
        """Stop every rotational motor; linear ones hold their position."""
        for motor in self.motors.values():
            if motor.getType() == Node.ROTATIONAL_MOTOR:
                motor.setPosition(float("inf"))
                motor.setVelocity(0.0)

    def step(self):
        """Serve the gateway for one step of the simulation."""
        if self.gateway is None:
            self.accept()
            return
        try:
            self.receive()
            if not self.unsent:  # a gateway that reads slowly misses whole readings, never parts of one
                self.unsent = b"".join(self.readings())
            self.send()
        except OSError:
            self.leave()

    def accept(self):
        try:
            self.gateway, _ = self.server.accept()
        except BlockingIOError:
            return
        self.gateway.setblocking(False)
        self.gateway.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.received = b""
        self.unsent = b"".join(self.registrations())

    def leave(self):
        self.gateway.close()
        self.gateway = None
        self.stop()

    def registrations(self):
        for number, device in enumerate(self.devices):
            name = device.getName().encode()[:NAME_BYTES]
            yield bytes((REGISTER, device.getNodeType() & 255, number, len(name))) + name

    def readings(self):
        for number, sensor in self.sensors:
            yield struct.pack("<BBBd", DATA, sensor.getNodeType() & 255, number, sensor.getValue())

    def receive(self):
        try:
            data = self.gateway.recv(4096)
        except BlockingIOError:
            return
        if not data:
            raise ConnectionError("the gateway disconnected")
        self.received += data
        while len(self.received) >= COMMAND_BYTES:
            command, _, number, value = struct.unpack_from("<BBBd", self.received)
            self.received = self.received[COMMAND_BYTES:]
            if command != SET_VALUE:
                raise ConnectionError(f"unknown command {command}: its length is unknown")
            self.set(number, value)

    def set(self, number, value):
        motor = self.motors.get(number)
        if motor is None or not math.isfinite(value):
            return
        if motor.getType() == Node.ROTATIONAL_MOTOR:
            most = motor.getMaxVelocity()
            motor.setVelocity(max(-most, min(most, value)))
        else:
            motor.setPosition(value)

    def send(self):
        try:
            sent = self.gateway.send(self.unsent)
        except BlockingIOError:
            return
        self.unsent = self.unsent[sent:]


def main():
    robot = Robot()
    bridge = Bridge(robot, int(sys.argv[1]) if len(sys.argv) > 1 else PORT)
    while robot.step(STEP_MS) != -1:
        bridge.step()


if __name__ == "__main__":
    main()
