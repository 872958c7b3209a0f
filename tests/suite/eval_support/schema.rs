//! The part of JSON Schema that `docs/schemas/eval.schema.json` uses, so that the output is held
//! against it on machines without Python too.

use serde_json::Value;

/// Where a document does not keep to a schema; empty when it does.
pub fn faults(schema: &Value, document: &Value) -> Vec<String> {
    let mut faults = Vec::new();
    check(schema, schema, document, "", &mut faults);
    faults
}

fn check(root: &Value, schema: &Value, value: &Value, at: &str, faults: &mut Vec<String>) {
    let list = |key: &str| schema[key].as_array().map_or(&[][..], Vec::as_slice);
    if schema == &Value::Bool(false) {
        faults.push(format!("{at}: must not be there"));
        return;
    }
    if let Some(reference) = schema["$ref"].as_str() {
        let target = reference.strip_prefix('#').and_then(|path| root.pointer(path));
        check(root, target.expect("a reference within the schema"), value, at, faults);
    }
    for part in list("allOf") {
        check(root, part, value, at, faults);
    }
    for key in ["anyOf", "oneOf"] {
        let tried: Vec<Vec<String>> = list(key)
            .iter()
            .map(|part| {
                let mut own = Vec::new();
                check(root, part, value, at, &mut own);
                own
            })
            .collect();
        let kept = tried.iter().filter(|own| own.is_empty()).count();
        if !tried.is_empty() && (kept == 0 || key == "oneOf" && kept > 1) {
            // The branch that comes nearest says what is wrong.
            faults.extend(tried.into_iter().min_by_key(Vec::len).unwrap_or_default());
        }
    }
    if let Some(expected) = schema.get("const")
        && expected != value
    {
        faults.push(format!("{at}: {value} is not {expected}"));
    }
    if schema.get("enum").is_some() && !list("enum").contains(value) {
        faults.push(format!("{at}: {value} is none of {}", schema["enum"]));
    }
    let types: Vec<&str> = match &schema["type"] {
        Value::String(one) => vec![one.as_str()],
        Value::Array(many) => many.iter().filter_map(Value::as_str).collect(),
        _ => vec![],
    };
    let is = |kind: &&str| match *kind {
        "object" => value.is_object(),
        "array" => value.is_array(),
        "string" => value.is_string(),
        "boolean" => value.is_boolean(),
        "integer" => value.is_u64() || value.is_i64(),
        "number" => value.is_number(),
        "null" => value.is_null(),
        other => panic!("type {other}"),
    };
    if !types.is_empty() && !types.iter().any(is) {
        faults.push(format!("{at}: {value} is not of type {types:?}"));
    }
    if let Some(items) = value.as_array()
        && schema.get("items").is_some()
    {
        for (i, item) in items.iter().enumerate() {
            check(root, &schema["items"], item, &format!("{at}/{i}"), faults);
        }
    }
    if let Some(fields) = value.as_object() {
        for name in list("required").iter().filter_map(Value::as_str) {
            if !fields.contains_key(name) {
                faults.push(format!("{at}/{name} is missing"));
            }
        }
        for (name, field) in fields {
            let at = format!("{at}/{name}");
            match (schema["properties"].get(name), schema.get("additionalProperties")) {
                (Some(property), _) => check(root, property, field, &at, faults),
                (None, Some(Value::Bool(false))) => faults.push(format!("{at}: no such field")),
                (None, Some(other)) => check(root, other, field, &at, faults),
                (None, None) => {}
            }
        }
    }
    if let Some(condition) = schema.get("if") {
        let mut own = Vec::new();
        check(root, condition, value, at, &mut own);
        let branch = if own.is_empty() { "then" } else { "else" };
        if let Some(branch) = schema.get(branch) {
            check(root, branch, value, at, faults);
        }
    }
}
