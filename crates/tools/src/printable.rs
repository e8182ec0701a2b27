//! Makes text from outside harmless (topics, names, fault texts, file contents, messages of other machines):
//! characters that a terminal would obey, that would begin another line or that would reorder text become visible.

use std::fmt::Write;

/// Whether a character changes the appearance of the text around it: control characters, bidirectional controls,
/// line separators, invisible ones.
fn is_unsafe(c: char) -> bool {
    c.is_control()
        || matches!(
            c,
            '\u{AD}'
                | '\u{61C}'
                | '\u{180E}'
                | '\u{200B}'..='\u{200F}'
                | '\u{2028}'..='\u{202E}'
                | '\u{2060}'..='\u{206F}'
                | '\u{FEFF}'
                | '\u{FFF9}'..='\u{FFFB}'
                | '\u{E0000}'..='\u{E007F}'
        )
}

/// A line or a part of one, with `\n` and `\u001b` in place of such characters. In a line of JSON these characters
/// can only be inside strings, where the escapes have the same meaning.
pub(super) fn line(text: &str) -> String {
    // Nearly every line of the log is plain.
    if text.bytes().all(|byte| matches!(byte, b' '..=b'~')) {
        return text.to_string();
    }
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '\n' => out.push_str("\\n"),
            '\r' => out.push_str("\\r"),
            '\t' => out.push_str("\\t"),
            c if is_unsafe(c) => {
                for unit in c.encode_utf16(&mut [0; 2]) {
                    // Writing to a string cannot fail.
                    let _ = write!(out, "\\u{unit:04x}");
                }
            }
            c => out.push(c),
        }
    }
    out
}

/// Text of several intended lines, with their tabs; the rest is treated as in [`line()`].
pub(super) fn lines(text: &str) -> String {
    let safe = |part: &str| part.split('\t').map(line).collect::<Vec<_>>().join("\t");
    text.split('\n').map(safe).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_commands_a_terminal_or_forges_a_line_is_shown() {
        let bad = "a\nINFO forged\r\x1b[2J\u{9b}31m\x07\u{202e}txt.exe\u{2066}\u{200b}\u{feff}\u{e0041}\u{2028}z";
        let shown =
            "a\\nINFO forged\\r\\u001b[2J\\u009b31m\\u0007\\u202etxt.exe\\u2066\\u200b\\ufeff\\udb40\\udc41\\u2028z";
        assert_eq!(line(bad), shown);
        assert_eq!(lines("a\n\t\x1b\nb\n"), "a\n\t\\u001b\nb\n");
        for fine in ["Müller 25 °C ␍␊ → 日本", "quotes \" \\ '", ""] {
            assert_eq!((line(fine).as_str(), lines(fine).as_str()), (fine, fine));
        }
        let json = line(&serde_json::to_string(bad).unwrap());
        assert!(!json.chars().any(is_unsafe), "{json}");
        assert_eq!(serde_json::from_str::<String>(&json).unwrap(), bad);
    }
}
