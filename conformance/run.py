"""Run a reader over the cases of the suite, and compare what it says with what is expected.

    python conformance/run.py -- COMMAND {file}
    python conformance/run.py --validator -- python tools/conformance_dump.py {file}
    python conformance/run.py --only datasets -- python conformance/reader.py {file}

COMMAND prints JSON (README.md says what). Keys that it leaves out are not compared, and are listed
at the end: a reader claims what it shows. Standard library alone.
"""

import argparse
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

CASES = Path(__file__).resolve().parent / "cases"
MOST_SECONDS = 120


def run(command, path):
    """The JSON that a command prints for a file; None: it failed without any."""
    words = [word.replace("{file}", str(path)) for word in command]
    try:
        done = subprocess.run(words, capture_output=True, timeout=MOST_SECONDS, check=False)
        found = json.loads(done.stdout)
    except (ValueError, subprocess.TimeoutExpired):
        return None
    return found if isinstance(found, dict) else None


def differences(due, found, place, left_out):
    """Places where a value is not the expected one; keys that are absent are left out."""
    if isinstance(due, dict) and isinstance(found, dict):
        left_out.update(f"{place}.{key}".lstrip(".") for key in due if key not in found)
        for key, value in found.items():
            if key in due:
                yield from differences(due[key], value, f"{place}.{key}", left_out)
            else:
                yield f"{place}.{key} is no key of the suite"
    elif are_objects(due) and are_objects(found) and len(due) == len(found):
        for one, other in zip(due, found, strict=True):
            yield from differences(one, other, place, left_out)
    elif due != found or isinstance(due, bool) != isinstance(found, bool):
        yield f"{place.lstrip('.')}: {shortened(found)} where {shortened(due)} is due"


def are_objects(value):
    """Whether it is a list of objects, which are compared one by one."""
    return isinstance(value, list) and all(isinstance(item, dict) for item in value)


def shortened(value):
    """A value for one line."""
    text = json.dumps(value)
    return text if len(text) <= 120 else f"{text[:80]} ... {text[-30:]}"


def brief(problems):
    """File and code of problems, sorted."""
    return sorted((problem.get("file", ""), problem.get("code", "")) for problem in problems)


def are_there(due, told):
    """Whether problems are those that are due, each at its place or, where told, within it."""
    places = [(problem["file"], problem["code"], problem["at"]) for problem in due]
    given = [(p.get("file"), p.get("code"), p.get("at")) for p in told]
    return len(places) == len(given) and all(
        any(
            one[:2] == other[:2] and (other[2] is None or f"{other[2]}.".startswith(within(one[2])))
            for other in given
        )
        for one in places
    )


def within(place):
    """What the name of a place begins with that is in another one."""
    return f"{place}." if place else ""


def wrong_of(case, found, is_validator, left_out):
    """What is wrong with what was said of a case."""
    if "expected" in case:
        if found is None:
            return ["nothing was read"]
        due = json.loads((CASES / case["expected"]).read_text())
        return list(differences(due, found, "", left_out))
    told = (found or {}).get("problems") or []
    if is_validator:
        if are_there(case["problems"], told):
            return []
        return [f"problems {told} where {case['problems']} are due"]
    if found is not None and not told and case["reader_refuses"]:
        return [f"was read, and has {brief(case['problems'])}"]
    codes = {code for _, code in brief(case["problems"])}
    strange = {code for _, code in brief(told)} - codes
    return [f"{strange} told where it is {codes}"] if strange else []


def main():
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--validator", action="store_true", help="every problem is to be told")
    parser.add_argument("--only", default="", help="cases whose path begins so")
    parser.add_argument("--without", default="", help="parts that are not claimed: values,messages")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("command", nargs=argparse.REMAINDER, help="-- COMMAND {file}")
    options = parser.parse_args()
    command = options.command[options.command[:1] == ["--"] :]
    if not any("{file}" in word for word in command):
        parser.error("the command needs a word with {file}")
    cases = json.loads((CASES / "cases.json").read_text())["cases"]
    cases = [case for case in cases if case["path"].startswith(options.only)]
    not_claimed = set(options.without.split(",")) - {""}
    strange = not_claimed - {case["part"] for case in cases}
    if strange:
        parser.error(f"there is no part {', '.join(sorted(strange))} here")
    cases = [case for case in cases if case["part"] not in not_claimed]
    left_out, failed = set(), 0
    with ThreadPoolExecutor(options.jobs) as pool:
        given = pool.map(lambda case: run(command, CASES / case["path"]), cases)
        for case, found in zip(cases, given, strict=True):
            wrong = wrong_of(case, found, options.validator, left_out)
            failed += bool(wrong)
            for line in wrong:
                print(f"FAILED {case['path']} ({case['shows']}): {line}")
    for key in sorted(left_out):
        print(f"not shown: {key}")
    print(f"{len(cases) - failed} of {len(cases)} cases passed")
    return 1 if failed or not cases else 0


if __name__ == "__main__":
    sys.exit(main())
