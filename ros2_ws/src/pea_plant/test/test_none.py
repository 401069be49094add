from pea_plant.model.hysteresis import none


def test_effective_voltage_is_the_voltage():
    c = none.design(none.Params(), 50e-6)
    s = none.update(c, none.start(c), 37.25)
    assert none.output(c, s) == 37.25


def test_rests_at_zero():
    c = none.design(none.Params(), 50e-6)
    assert none.output(c, none.start(c)) == 0.0
