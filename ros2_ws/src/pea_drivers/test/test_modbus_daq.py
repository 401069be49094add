import math
import struct
import time

import pytest
from pymodbus.client import ModbusTcpClient

from pea_core.params import ParameterError
from pea_drivers.modbus_daq import Params as ModbusParams
from pea_plant.drivers.driver import DriverError

PATIENCE = 20.0


@pytest.fixture
def kind():
    return "modbus_daq"


def test_it_reads_identity_and_limits(driver):
    assert driver.identity == "LabJack T7, serial number 470012345, firmware 1.0307"
    assert driver.limits == pytest.approx((-20.0, 340.0 / 3.0, -19e-6, 21e-6))


def test_converters_have_steps(bench):
    with bench.emulated(dac_bits=12, ain_bits=16) as device:
        driver = bench.driver(device)
        driver.connect()
        driver.exchange(50.01)
        step = 5.0 / 4096 / 0.0375
        assert abs(device.stage.u - 50.01) <= step / 2
        assert (device.stage.u + 20.0) / step == pytest.approx(
            round((device.stage.u + 20.0) / step)
        )
        code = (driver.read().y * 1e6 - 1.0) / 2.0 / (20.0 / 65536)
        assert code == pytest.approx(round(code), abs=1e-3)
        driver.close()


def test_no_step_of_the_output_leaves_the_range(bench):
    with bench.emulated(dac_bits=12) as device:
        driver = bench.driver(device)
        driver.connect()
        for u in (-20.0, 110.0):
            driver.exchange(u)
            assert device.stage.u == pytest.approx(u, abs=0.05)
            assert -20.0 <= device.stage.u <= 110.0
        driver.close()


def test_the_trigger_line_is_high_for_a_sample(bench, device):
    driver = bench.driver(device, driver__trigger="line", driver__trigger_fio=3)
    driver.connect()
    host, _, port = device.address.removeprefix("tcp://").partition(":")
    client = ModbusTcpClient(host, port=int(port), timeout=PATIENCE)
    levels = []
    for marked in (False, True, False, True, True, False):
        if marked:
            driver.mark()
        driver.exchange(10.0)
        levels += client.read_holding_registers(2003, count=1, device_id=1).registers
    client.close()
    driver.close()
    assert levels == [0, 1, 0, 1, 1, 0]
    assert device.told()["counts"]["pulses of FIO3"] == 2


def test_the_sample_signal_is_read_in_the_same_frame(bench):
    values = {"driver__signal_ain": 3, "stage__specimen": "2 + 0.1*x"}
    with bench.emulated(bench.plant(**values)) as device:
        driver = bench.driver(device, **values)
        driver.connect()
        driver.exchange(60.0)
        time.sleep(0.1)  # the stage goes there
        measured = driver.exchange(60.0)
        driver.close()
        assert measured.y > 4e-6
        assert driver.signal == pytest.approx(2.0 + 0.1e6 * measured.y, abs=1e-2)
        assert device.told()["counts"]["commands"] == 2


def test_a_rig_without_a_detector_has_no_signal(driver):
    driver.exchange(10.0)
    assert math.isnan(driver.signal)


def test_an_input_that_is_not_there_is_refused(bench, device):
    bench.refuses(device, "signal_ain = 200: not an input", driver__signal_ain=200)


def test_the_input_of_the_sensor_is_no_detector():
    with pytest.raises(ParameterError, match="signal_ain = 0: is the input of the displacement"):
        ModbusParams(signal_ain=0)


def test_without_a_trigger_no_line_is_touched(device, driver):
    driver.exchange(10.0)
    assert not any("FIO" in name for name in device.told()["counts"])


def test_a_plain_modbus_client_sees_the_same_registers(device, driver):
    driver.exchange(50.0)
    host, _, port = device.address.removeprefix("tcp://").partition(":")
    client = ModbusTcpClient(host, port=int(port), timeout=PATIENCE)
    read = client.read_holding_registers(1000, count=2, device_id=1).registers
    assert struct.unpack(">f", struct.pack(">2H", *read)) == pytest.approx((0.75 + 0.0375 * 50.0,))
    assert client.read_input_registers(60000, count=2, device_id=1).registers == [0x40E0, 0]
    client.write_registers(1000, [0x4000, 0], device_id=1)  # 2 V
    assert device.stage.u == pytest.approx((2.0 - 0.75) / 0.0375)
    assert client.read_holding_registers(1001, count=2, device_id=1).exception_code == 2
    client.close()
    with pytest.raises(DriverError, match="is somebody else connected"):
        driver.check()


@pytest.mark.parametrize(
    ("of_device", "of_rig", "says"),
    [
        ({"product": 4.0}, {}, r"driver.model = 'T7': at tcp.* is LabJack T4"),
        ({"product": 9.0}, {}, r"driver.model = 'T7': .*product 9"),
        ({}, {"driver__ain": 14}, r"driver.ain = 14: not an input .*error 2 \(illegal data addr"),
        ({}, {"driver__ain_range": 1.0}, r"driver.ain_range = 1: the input is set to \+-10 V"),
        ({}, {"driver__dac_max": 4.0}, r"^voltage_max = 110: must lie within -20 to 86.66\d* V"),
        ({}, {"voltage_min": -30.0}, r"^voltage_min = -30: must lie within -20 to 113"),
    ],
)
def test_what_does_not_fit_is_refused_and_nothing_moves(bench, of_device, of_rig, says):
    with bench.emulated(**of_device) as device:
        bench.refuses(device, says, **of_rig)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"driver__calibration__amplifier": (0.0, 1.0, -0.01)}, "calibration.amplifier = .*rise"),
        ({"driver__calibration__sensor": (0.0, 1.0, -0.1)}, "calibration.sensor = .*rise or fall"),
        ({"driver__dac_min": 5.0}, r"dac_min = 5: must be below dac_max"),
        ({"address": "serial:/dev/ttyUSB0"}, r"address = .*Modbus TCP needs tcp"),
        ({"driver__model": "T9"}, r"model = 'T9'"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_opened(bench, values, says):
    with pytest.raises(ParameterError, match="driver." + says):
        bench.make(**values)


@pytest.mark.parametrize(
    ("code", "name"), [(3, "illegal data value"), (6, "server device busy"), (77, "unknown")]
)
def test_an_error_of_the_device_has_its_name(device, driver, code, name):
    driver.exchange(10.0)
    device.inject(f"error={code}")
    with pytest.raises(DriverError, match=rf"error {code} \({name}\) on register 0, 1000"):
        driver.exchange(20.0)
    assert device.stage.u == pytest.approx(10.0, abs=1e-5)
    assert driver.read().u_applied == pytest.approx(10.0, abs=1e-5)  # read back: not taken


def test_a_pty_is_refused(bench):
    with pytest.raises(ParameterError, match="give a port, not a pty"):
        bench.emulated(port=None)


@pytest.fixture
def client(device):
    host, _, port = device.address.removeprefix("tcp://").partition(":")
    plain = ModbusTcpClient(host, port=int(port), timeout=PATIENCE)
    yield plain
    plain.close()


def words(form, *values):
    data = struct.pack(f">{form}", *values)
    return list(struct.unpack(f">{len(data) // 2}H", data))


def read(client, address, form):
    count = struct.calcsize(f">{form}") // 2
    registers = client.read_holding_registers(address, count=count, device_id=1).registers
    return struct.unpack(f">{form}", struct.pack(f">{count}H", *registers))


def code(answer):
    return answer.exception_code if answer.isError() else 0


@pytest.mark.parametrize(
    ("address", "form", "value"),
    [
        (55100, "I", 0x00112233),
        (55110, "H", 0x0011),
        (55120, "I", 0x00112233),
        (55122, "i", -2003195205),
        (55124, "f", -9999.0),
        (60000, "f", 7.0),
        (60028, "I", 470012345),
        (60500, "50s", b"pea".ljust(50, b"\0")),
        (40000, "f", 10.0),
        (41000, "H", 199),
        (43900, "f", 10.0),
        (61600, "I", 0),
        (61642, "f", 0.0),
    ],
)
def test_registers_have_what_the_device_has_at_power_on(client, address, form, value):
    assert read(client, address, form) == (value,)


def test_the_core_timer_runs(client):
    first = read(client, 61520, "I")[0]
    assert read(client, 61520, "I")[0] != first


@pytest.mark.parametrize(
    ("address", "values", "wrong"),
    [
        (1000, words("f", 2.0), 0),
        (1000, words("2f", 2.0, 1.0), 0),  # both outputs in one block
        (1000, words("f", float("nan")), 3),
        (1000, [1], 2),  # half a value
        (1001, [1, 2], 2),
        (0, words("f", 2.0), 2),  # an input
        (55100, words("I", 1), 2),
        (55120, words("I", 1), 0),
        (60000, words("f", 4.0), 2),
        (61520, words("I", 1), 2),
        (40000, words("f", 1.0), 0),
        (40000, words("f", 3.0), 3),
        (41500, [12], 0),
        (41500, [13], 3),
        (51000, words("I", 65536), 3),
        (60500, words("50s", b"bench 2\0"), 0),
        (60500, words("50s", b"x" * 50), 3),  # without its end
        (60500, words("50s", b"a.b\0"), 3),
        (65535, [1], 2),
        (1000, words("3f", 1.0, 1.0, 1.0), 2),  # one further than there are
    ],
)
def test_what_can_be_written(device, client, address, values, wrong):
    assert code(client.write_registers(address, values, device_id=1)) == wrong
    if wrong:
        assert device.stage.u == 0.0


def test_a_single_register_is_written_by_function_6(client):
    assert code(client.write_register(41500, 8, device_id=1)) == 0
    assert read(client, 41500, "H") == (8,)
    assert code(client.write_register(1000, 8, device_id=1)) == 2
    assert code(client.write_register(55100, 8, device_id=1)) == 2


def test_other_functions_are_refused(device, client):
    assert code(client.read_coils(0, count=1, device_id=1)) == 1
    assert device.session().feed(bytes.fromhex("000700000003016300")).hex() == "00070000000301e301"


def test_what_can_only_be_written_is_not_read(client):
    for address in (51000, 61614):
        assert code(client.read_holding_registers(address, count=2, device_id=1)) == 2


def test_a_range_of_the_input_holds_for_its_reading(device, client):
    client.write_registers(40000, words("f", 0.1), device_id=1)
    device.inject("jump=50")
    assert read(client, 0, "f")[0] == pytest.approx(0.1, rel=1e-3)
    assert read(client, 43900, "f") == (-9999.0,)  # the inputs differ


def test_the_watchdog_sets_an_output_when_nobody_talks(device, client):
    def write(address, form, value):
        return code(client.write_registers(address, words(form, value), device_id=1))

    assert write(61600, "I", 1) == 3  # no time-out yet
    for address, form, value in ((61604, "I", 1), (61640, "I", 1), (61642, "f", 0.75)):
        assert write(address, form, value) == 0
    write(1000, "f", 4.0)
    assert write(61600, "I", 1) == 0
    assert write(61604, "I", 5) == 2  # not while it is on
    end = time.monotonic() + PATIENCE
    while abs(device.stage.u) > 1e-6:
        assert time.monotonic() < end
        time.sleep(0.01)
    assert device.outputs[0] == 0.75


def test_it_takes_two_clients(bench, device, driver):
    second = bench.driver(device)
    second.connect()
    third = bench.driver(device)
    with pytest.raises(ParameterError, match=r"closed the connection|reset by peer|broken pipe"):
        third.connect()
    second.close()
    driver.exchange(10.0)
