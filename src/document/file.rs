//! Reading a document's file, and what to say of one that is no text.

use std::path::Path;

use super::Problem;

/// Reads a file for a document; the problem says why it cannot.
///
/// # Errors
/// One problem that names the file, and where it stops being text.
pub fn read_file(path: &Path) -> Result<String, Problem> {
    let problem = |line, message| Problem {
        file: path.display().to_string(),
        line,
        key: String::new(),
        message,
    };
    let bytes = std::fs::read(path).map_err(|error| {
        let message = format!("cannot read the file: {error}; check the path and its permissions");
        problem(None, message)
    })?;
    text(bytes).map_err(|(line, message)| problem(line, message))
}

/// The text in `bytes`, or where it is none, with its line, and what to do.
fn text(bytes: Vec<u8>) -> Result<String, (Option<usize>, String)> {
    // Some shells and editors of Windows write it unasked; what follows may look like text with holes.
    if bytes.starts_with(&[0xFF, 0xFE]) || bytes.starts_with(&[0xFE, 0xFF]) {
        let message = "the file is UTF-16 text; save it as UTF-8".to_string();
        return Err((None, message));
    }
    let sound = match std::str::from_utf8(&bytes) {
        Ok(_) => bytes.len(),
        Err(error) => error.valid_up_to(),
    };
    // A zero byte is UTF-8 and stands in no text: it tells of a program, an archive, or a file that was cut by a crash.
    let zero = bytes.iter().position(|byte| *byte == 0).unwrap_or(sound);
    let end = sound.min(zero);
    let (before, rest) = bytes.split_at_checked(end).unwrap_or((&bytes, &[]));
    let Some(byte) = rest.first() else {
        // Nothing is lossy here: all of it is sound.
        return Ok(String::from_utf8(bytes).unwrap_or_default());
    };
    let before = String::from_utf8_lossy(before);
    let line = before.matches('\n').count() + 1;
    let column = before.rsplit('\n').next().unwrap_or_default().chars().count() + 1;
    let message = format!(
        "the file is no text: byte 0x{byte:02X} at line {line}, column {column}; save it as UTF-8 text, or name the file \
         that was meant"
    );
    Err((Some(line), message))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn where_a_file_stops_being_text() {
        let told = |bytes: &[u8]| text(bytes.to_vec());
        for good in ["", "a = 1\n", "# Übergabe ℃\r\n", "\u{FEFF}a = 1", "\u{FFFD}"] {
            assert_eq!(told(good.as_bytes()).as_deref(), Ok(good));
        }
        let place = |bytes: &[u8]| {
            let (line, message) = told(bytes).unwrap_err();
            let (what, remedy) = message.split_once("; ").unwrap();
            assert_eq!(remedy, "save it as UTF-8 text, or name the file that was meant");
            (line, what.strip_prefix("the file is no text: ").unwrap().to_string())
        };
        let at = |byte: &str, line: usize, column: usize| {
            (Some(line), format!("byte 0x{byte} at line {line}, column {column}"))
        };
        assert_eq!(place(b"\x7FELF\x02\x01\x01\x00\xFF"), at("00", 1, 8));
        // Latin-1, behind a letter of two bytes and one column.
        assert_eq!(place(b"a = 1\n# \xC3\x9Cbergabe 20 \xB0C\n"), at("B0", 2, 15));
        assert_eq!(place(b"\xB0\x00"), at("B0", 1, 1));
        assert_eq!(place(b"a = 1\n\x00\xB0"), at("00", 2, 1));
        // The last letter is cut off.
        assert_eq!(place(b"a\r\n\r\nb\xC3"), at("C3", 3, 2));
        for utf16 in [b"\xFF\xFEa\0".as_slice(), b"\xFE\xFF\0a"] {
            assert_eq!(
                told(utf16),
                Err((None, "the file is UTF-16 text; save it as UTF-8".to_string()))
            );
        }
    }
}
