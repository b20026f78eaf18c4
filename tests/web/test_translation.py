"""Every sentence that an operator reads is there in each language, with the same values in it."""

from __future__ import annotations

import pickle
import re

import pytest

from flasher.host.verify import GOOD, Level, Verdict, Verification
from flasher.i18n import Text, text, with_value
from flasher.protocol.spec import TARGETS
from flasher.station.scans import Word
from flasher.translation import chosen, translator
from tests import catalogue
from tests.loops import each

_CARDS = re.compile(rf"\b({'|'.join(Word)})\b")
"""The text of the operator's cards is the same in every language."""


@pytest.mark.slow
def test_nothing_is_left_untranslated() -> None:
    """`python -m tests.catalogue` adds what is missing."""
    everything = set(catalogue.sentences())  # it reads the whole package
    for language in catalogue.LANGUAGES:
        known = catalogue.messages(language)
        assert everything == known.keys(), language
        assert [english for english, reported in known.items() if not reported] == [], language


@each("language", catalogue.LANGUAGES)
def test_values_and_scans_stand_in_every_language(language: str) -> None:
    for english, reported in catalogue.messages(language).items():
        assert catalogue.fields(reported) == catalogue.fields(english), english
        if "." in english:  # a sentence, not the name of a state
            assert set(_CARDS.findall(reported)) == set(_CARDS.findall(english)), english


@pytest.mark.slow
def test_a_sentence_is_translated_by_its_template() -> None:
    wanted = text("Put {label} into socket {socket}.", label="W1", socket="A")
    assert wanted == "Put W1 into socket A."
    assert translator("de")(wanted) == "W1 auf Platz A setzen."
    both = text("{wanted} Or scan {way}.", wanted=wanted, way="CANCEL")
    assert translator("de")(both) == "W1 auf Platz A setzen. Oder CANCEL scannen."
    assert translator("en")(both) == both == "Put W1 into socket A. Or scan CANCEL."


def test_a_value_is_never_taken_for_a_template() -> None:
    reported = text("Scan {label}.", label="{socket} %s {0}")
    assert translator("de")(reported) == "{socket} %s {0} scannen."


def test_a_value_is_exchanged_at_any_place() -> None:
    inner = text("Put {label} into socket {socket}.", label=text("W1"), socket="A")
    both = text("{wanted} Or scan CANCEL.", wanted=inner)
    assert with_value(both, "W1", "W2") == "Put W2 into socket A. Or scan CANCEL."
    assert translator("de")(with_value(both, "W1", "W2")).startswith("W2 auf Platz A setzen.")
    assert with_value("W1", "W1", "W2") == "W2"
    assert with_value("W1 and W3", "W1", "W2") == "W1 and W3"


def test_a_sentence_passes_from_process_to_process() -> None:
    reported = pickle.loads(pickle.dumps(text("Connect {label}.", label="W1")))  # noqa: S301  our own
    assert isinstance(reported, Text)
    assert translator("de")(reported) == "W1 anschließen."


def test_what_no_catalogue_knows_stays_as_it_is() -> None:
    assert translator("zh")("relay 3: no such file") == "relay 3: no such file"
    assert [translator("zh")(each) for each in ("", ".", " ")] == ["", ".", " "]


def test_plain_english_is_translated_by_the_sentence_that_it_matches() -> None:
    german = translator("de")
    assert german("Put W1 into socket A.") == "W1 auf Platz A setzen."
    assert german("Put W1 into socket A. Connect W2.") == "W1 auf Platz A setzen. W2 anschließen."
    assert german("Put W1 into socket A. Relay 3 fell off.").endswith(". Relay 3 fell off.")
    assert translator("en")("Put W1 into socket A.") == "Put W1 into socket A."


def test_numbers_are_written_as_in_the_language() -> None:
    german = translator("de")
    assert (
        german.numbers("1,234.5 s, version 1.2.3, 65,535.") == "1.234,5 s, version 1.2.3, 65.535."
    )
    assert german("{seconds:.1f} s", seconds=1234.56) == "1234,6 s"
    assert translator("zh").numbers("1,234.5 s") == "1,234.5 s"


@pytest.mark.parametrize(
    ("wanted", "accepted", "code"),
    [
        ("de", ["en"], "de"),
        (None, ["de-AT", "en"], "de"),
        (None, ["zh-CN;q=0.9"], "zh"),
        (None, ["fr", "zh"], "zh"),
        (None, ["fr"], "en"),
        ("xx", [], "en"),
        ("../../etc", [], "en"),
    ],
)
def test_the_language_of_a_page(wanted: str | None, accepted: list[str], code: str) -> None:
    assert chosen(wanted, accepted).code == code


@pytest.mark.slow
@each("joined", ["a: b; c (d) " * 80, "Xy. " * 240, "; " * 490, "There is no run 7. " * 50])
def test_a_text_of_very_many_parts_stays_as_it_is_and_costs_little(joined: str) -> None:
    """Files, devices and data bases make such texts; every page waits for their translation."""
    translate = translator("de")
    translate._plain.cache_clear()

    assert translate(joined) == joined
    assert translate._plain.cache_info().misses == 1


def test_brackets_with_two_clauses_stay_one_part() -> None:
    why = "the battery gives 3336 mA, more than 1000 mA; --allow-in-use waives this"
    assert translator("de")(f"BMS: the vehicle is in use ({why}).") == (
        "BMS: das Fahrzeug wird benutzt (die Batterie gibt 3336 mA ab, mehr als 1000 mA;"
        " --allow-in-use erlässt dies)."
    )


@pytest.mark.parametrize(
    ("language", "translated"),
    [
        ("de", "abgeschlossen, aber der Speicher weicht vom Image ab"),
        ("zh", "存储区与固件不一致"),
    ],
)
def test_a_verification_that_fails_is_translated_whole(language: str, translated: str) -> None:
    error = Verification(
        Level.MEMORY, Verdict.MEMORY_OTHER, None, "first at 0x08009000: FF instead of 00"
    ).error(TARGETS["bms"])
    assert error is not None
    text = translator(language)(error.what)
    assert "completed" not in text
    assert "instead" not in text
    assert translated in text


@each("language", ["de", "zh"])
@each("verdict", [each for each in Verdict if each not in GOOD])
def test_each_failed_verification_is_translated(verdict: Verdict, language: str) -> None:
    error = Verification(Level.VERSION, verdict).error(TARGETS["bms"])
    assert error is not None
    translated = translator(language)
    shown = " ".join(map(translated, (error.what, error.cause, error.remedy)))
    assert not re.findall(r"\b(?:a|the|it|and|then|is)\b", shown)
