//! Common mistakes in TOML, and their corrections. Pure.

use super::Finding;

/// The common mistake in this line of `source`, if there is one.
pub(super) fn named(source: &str, line: Option<usize>) -> Option<Finding> {
    other_format(source).or_else(|| in_line(source.lines().nth(line?.checked_sub(1)?)?))
}

/// The file format if the whole file is not TOML.
fn other_format(source: &str) -> Option<Finding> {
    let mut lines = source.lines().map(str::trim);
    let first = lines.find(|line| !line.is_empty() && !line.starts_with('#'))?;
    let format = match first {
        _ if first.starts_with('{') => "JSON",
        "---" => "YAML",
        _ if colon(first).is_some() && !source.contains(" = ") => "YAML",
        _ => return None,
    };
    Some(Finding::new(
        format!("the file looks like {format}"),
        "write TOML: a section such as [[bus]] on a line of its own, then lines such as name = \"line1\"; `drivegate try` \
         writes a configuration for a drive that it finds",
    ))
}

/// The key before a colon that was written instead of an equals sign, and the value.
fn colon(line: &str) -> Option<(&str, &str)> {
    let (key, value) = line.split_once(':')?;
    let is_key = !key.is_empty() && key.chars().all(|c| c.is_alphanumeric() || "_-. ".contains(c));
    is_key.then_some((key.trim(), value.trim()))
}

fn in_line(line: &str) -> Option<Finding> {
    if line.contains(['“', '”', '„', '‘', '’']) {
        return Some(Finding::new(
            "the line has typographic quotes",
            "write straight ones, \"...\"",
        ));
    }
    let Some((_, value)) = line.split_once('=') else {
        let (key, value) = colon(line.trim())?;
        return Some(Finding::new("a colon after the key", format!("write {key} = {value}")));
    };
    // The value follows the key, or is inside a list or an inline table.
    let value = value.split('#').next()?.trim();
    let values = value.split([',', '[', ']', '{', '}']);
    let mut values = values.filter_map(|part| part.rsplit('=').next());
    decimal_comma(value).or_else(|| values.find_map(|part| word(part.trim())))
}

fn decimal_comma(value: &str) -> Option<Finding> {
    let (whole, fraction) = value.split_once(',')?;
    let digits = |text: &str| !text.is_empty() && text.chars().all(|c| c.is_ascii_digit());
    let is_number = digits(whole.trim_start_matches(['-', '+'])) && digits(fraction);
    is_number.then(|| {
        Finding::new(
            format!("`{value}` has a decimal comma"),
            format!("write {whole}.{fraction}"),
        )
    })
}

/// The mistake in a word without quotes, or in a number with a unit.
fn word(word: &str) -> Option<Finding> {
    if let Some(number) = word
        .strip_suffix('%')
        .filter(|number| number.trim().parse::<f64>().is_ok())
    {
        let number = number.trim();
        return Some(Finding::new(
            format!("`{word}` has its unit"),
            format!("write {number}, without %"),
        ));
    }
    let is_value = word.parse::<f64>().is_ok() || ["true", "false"].contains(&word);
    let is_text = word.chars().any(char::is_alphabetic) && !word.contains(['"', '\'']);
    (is_text && !is_value).then(|| Finding::new(format!("`{word}` has no quotes"), format!("write \"{word}\"")))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(source: &str, line: usize) -> String {
        named(source, Some(line)).map_or(String::new(), |found| format!("{}; {}", found.what, found.remedy))
    }

    #[test]
    fn another_format_is_named() {
        for (source, format) in [
            ("{\"bus\": []}", "JSON"),
            ("# mine\n---\nbus:\n", "YAML"),
            ("bus:\n  - name: line1\n", "YAML"),
        ] {
            assert!(message(source, 1).starts_with(&format!("the file looks like {format}; write TOML")));
        }
        assert_eq!(message("[gateway]\nname = \"a: b\"\nx = = 1\n", 1), "");
    }

    #[test]
    fn the_mistake_of_a_line_is_named() {
        for (line, wanted) in [
            ("baud = 20,5", "`20,5` has a decimal comma; write 20.5"),
            ("limits = { a = 20% }", "`20%` has its unit; write 20, without %"),
            ("cycle = 10ms # fast", "`10ms` has no quotes; write \"10ms\""),
            ("name = pump-house", "`pump-house` has no quotes; write \"pump-house\""),
            ("buses = [line1, \"line2\"]", "`line1` has no quotes; write \"line1\""),
            (
                "name = “pump”",
                "the line has typographic quotes; write straight ones, \"...\"",
            ),
            ("name: \"pump\"", "a colon after the key; write name = \"pump\""),
            ("a = [1, 2", ""),
            ("a = -1.5e3 true", "`-1.5e3 true` has no quotes; write \"-1.5e3 true\""),
            ("name = \"line1", ""),
        ] {
            assert_eq!(message(&format!("x = 1\n{line}\n"), 2), wanted, "{line}");
        }
    }
}
