//! Topic names and topic filters (MQTT 5.0 section 4.7; the same in 3.1.1).
//!
//! These functions replace those of the library, whose `matches` refuses every `$` topic and panics on a topic that
//! starts with a character of more than one byte, and whose `valid_topic` accepts an empty name.

/// Whether `name` can be published to: not empty, no wildcard, no null character.
pub(super) fn is_name(name: &str) -> bool {
    !name.is_empty() && !name.contains(['+', '#', '\0'])
}

/// Whether `filter` is a valid subscription: a wildcard is alone in its level, and `#` only in the last level.
pub(super) fn is_filter(filter: &str) -> bool {
    if filter.is_empty() || filter.contains('\0') {
        return false;
    }
    let mut levels = filter.split('/').peekable();
    while let Some(level) = levels.next() {
        let valid = match level {
            "#" => levels.peek().is_none(),
            "+" => true,
            _ => !level.contains(['+', '#']),
        };
        if !valid {
            return false;
        }
    }
    true
}

/// Whether the valid topic `name` belongs to the valid `filter`. A leading wildcard does not reach
/// the topics that start with `$`.
pub(super) fn matches(name: &str, filter: &str) -> bool {
    if name.starts_with('$') && filter.starts_with(['+', '#']) {
        return false;
    }
    let mut names = name.split('/');
    for level in filter.split('/') {
        match (level, names.next()) {
            // `a/#` also matches `a` itself, so this case comes before the check for a missing level.
            ("#", _) => return true,
            ("+", Some(_)) => {}
            (level, Some(name)) if level == name => {}
            _ => return false,
        }
    }
    names.next().is_none()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_has_no_wildcard_and_is_not_empty() {
        for good in ["a", "/", "a//b", "a b/ü", "$SYS/x"] {
            assert!(is_name(good), "{good}");
        }
        for bad in ["", "a/+", "a#", "+", "a\0b"] {
            assert!(!is_name(bad), "{bad:?}");
        }
    }

    #[test]
    fn a_wildcard_stands_alone_in_its_level() {
        for good in ["a", "#", "+", "/", "a/#", "+/+/#", "/+", "a//#", "$SYS/#"] {
            assert!(is_filter(good), "{good}");
        }
        for bad in ["", "a#", "a/#/b", "#/a", "a+", "a/+b/c", "++", "##", "a\0"] {
            assert!(!is_filter(bad), "{bad:?}");
        }
    }

    #[test]
    fn names_match_as_the_standard_says() {
        // The examples of MQTT 5.0 sections 4.7.1 and 4.7.2, and the library's weak spots.
        for (name, filter) in [
            ("sport/tennis/player1", "sport/tennis/player1/#"),
            ("sport/tennis/player1/ranking", "sport/tennis/player1/#"),
            ("sport", "sport/#"),
            ("a/b", "#"),
            ("sport/tennis/player1", "sport/tennis/+"),
            ("sport/", "sport/+"),
            ("/finance", "+/+"),
            ("/finance", "/+"),
            ("$SYS/monitor/Clients", "$SYS/#"),
            ("$SYS/monitor/Clients", "$SYS/monitor/+"),
            ("üüü/b", "+/b"),
        ] {
            assert!(matches(name, filter), "{name} {filter}");
        }
        for (name, filter) in [
            ("sport/tennis/player1/ranking", "sport/tennis/+"),
            ("sport", "sport/+"),
            ("/finance", "+"),
            ("$SYS/monitor/Clients", "#"),
            ("$SYS/monitor/Clients", "+/monitor/Clients"),
            ("sports", "sport/#"),
            ("a/b", "a"),
            ("a", "a/b"),
            ("A", "a"),
        ] {
            assert!(!matches(name, filter), "{name} {filter}");
        }
    }
}
