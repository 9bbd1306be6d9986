"""Check of a value against a JSON Schema: the keywords that the schema of rig files uses."""

import math

_TYPES = {"object": dict, "array": list, "string": str, "null": type(None), "boolean": bool}
_IGNORED = {"$schema", "$defs", "title", "description", "default"}


def is_valid(value, schema, root=None):
    """Whether a value as YAML reads it fits a schema; an unknown keyword is an error."""
    root = schema if root is None else root
    return all(
        _holds(word, given, value, schema, root)
        for word, given in schema.items()
        if word not in _IGNORED
    )


def _holds(word, given, value, schema, root):
    def fits(part, one=value):
        return is_valid(one, part, root)

    if word == "$ref":
        return fits(root["$defs"][given.removeprefix("#/$defs/")])
    if word == "type":
        return _is_type(value, given)
    if word == "const":
        return type(value) is type(given) and value == given
    if word == "enum":
        return value in given
    if word in ("anyOf", "oneOf", "allOf"):
        n = sum(map(fits, given))
        return {"anyOf": n > 0, "oneOf": n == 1, "allOf": n == len(given)}[word]
    if word == "not":
        return not fits(given)
    if word == "if":
        return fits(schema["then"]) if fits(given) else True
    if word == "then":
        return True
    if isinstance(value, dict):
        if word == "properties":
            return all(fits(part, value[key]) for key, part in given.items() if key in value)
        if word == "required":
            return set(given) <= set(value)
        if word == "additionalProperties":
            return given or set(value) <= set(schema["properties"])
    if isinstance(value, list):
        if word == "items":
            return all(fits(given, one) for one in value)
        if word == "contains":
            return any(fits(given, one) for one in value)
    sizes = {"minItems": list, "maxItems": list, "minLength": str}
    if word in sizes:
        if not isinstance(value, sizes[word]):
            return True
        return len(value) <= given if word.startswith("max") else len(value) >= given
    limits = {
        "minimum": lambda: value >= given,
        "maximum": lambda: value <= given,
        "exclusiveMinimum": lambda: value > given,
    }
    if word in limits:
        return limits[word]() if _is_type(value, "number") else True
    if word in ("properties", "required", "additionalProperties", "items", "contains"):
        return True
    raise AssertionError(f"keyword {word!r} is not known here")


def _is_type(value, name):
    if name in ("number", "integer"):
        kinds = (int, float) if name == "number" else int
        return isinstance(value, kinds) and not isinstance(value, bool) and math.isfinite(value)
    return isinstance(value, _TYPES[name])
