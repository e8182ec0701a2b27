//! Reads the text of a document, and reports where a file stops being text.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use super::{Finding, Problem};

/// Longest file that is read, bytes; no document is longer.
const LONGEST: u64 = 16 << 20;

/// Why bytes are not valid text of a document.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
enum NotText {
    #[error("the file is UTF-16 text")]
    Utf16,
    #[error("the file is not text: byte 0x{byte:02X} at line {line}, column {column}")]
    Byte { byte: u8, line: usize, column: usize },
}

/// Reads a file for a document.
///
/// # Errors
/// If the file cannot be read; the line is given where it stops being text.
pub fn read_file(path: &Path) -> Result<String, Problem> {
    let of_file =
        |what: String, remedy: &str| Problem::of_file(path.display().to_string(), "", Finding::new(what, remedy));
    let mut bytes = Vec::new();
    let read = File::open(path).and_then(|file| file.take(LONGEST + 1).read_to_end(&mut bytes));
    read.map_err(|error| {
        of_file(
            format!("cannot read the file: {error}"),
            "check the path and its permissions",
        )
    })?;
    let is_long = bytes.len() as u64 > LONGEST;
    // A program or an archive is reported as such.
    if is_long && !bytes.contains(&0) {
        return Err(of_file(
            format!("the file is longer than {} MiB", LONGEST >> 20),
            "name the intended file",
        ));
    }
    text(bytes).map_err(|error| match error {
        NotText::Utf16 => of_file(error.to_string(), "save it as UTF-8"),
        NotText::Byte { line, .. } => Problem {
            line: Some(line),
            ..of_file(error.to_string(), "save it as UTF-8 text, or name the intended file")
        },
    })
}

fn text(bytes: Vec<u8>) -> Result<String, NotText> {
    // Some shells and editors on Windows write UTF-16 by default.
    if bytes.starts_with(&[0xFF, 0xFE]) || bytes.starts_with(&[0xFE, 0xFF]) {
        return Err(NotText::Utf16);
    }
    let sound = match std::str::from_utf8(&bytes) {
        Ok(_) => bytes.len(),
        Err(error) => error.valid_up_to(),
    };
    // A zero byte is valid UTF-8 but never part of a text: the file is a program, an archive, or was cut by a crash.
    let zero = bytes.iter().position(|byte| *byte == 0).unwrap_or(sound);
    let end = sound.min(zero);
    let (before, rest) = bytes.split_at_checked(end).unwrap_or((&bytes, &[]));
    let Some(&byte) = rest.first() else {
        // All bytes were validated above.
        return Ok(String::from_utf8(bytes).unwrap_or_default());
    };
    let before = String::from_utf8_lossy(before);
    Err(NotText::Byte {
        byte,
        line: before.matches('\n').count() + 1,
        column: before.rsplit('\n').next().unwrap_or_default().chars().count() + 1,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn where_a_file_stops_being_text() {
        let text = |bytes: &[u8]| text(bytes.to_vec());
        for good in ["", "a = 1\n", "# Übergabe ℃\r\n", "\u{FEFF}a = 1", "\u{FFFD}"] {
            assert_eq!(text(good.as_bytes()).as_deref(), Ok(good));
        }
        let at = |byte, line, column| Err(NotText::Byte { byte, line, column });
        assert_eq!(text(b"\x7FELF\x02\x01\x01\x00\xFF"), at(0, 1, 8));
        // Latin-1, after a character of two bytes and one column.
        assert_eq!(text(b"a = 1\n# \xC3\x9Cbergabe 20 \xB0C\n"), at(0xB0, 2, 15));
        assert_eq!(text(b"\xB0\x00"), at(0xB0, 1, 1));
        assert_eq!(text(b"a = 1\n\x00\xB0"), at(0, 2, 1));
        // The last character is cut off.
        assert_eq!(text(b"a\r\n\r\nb\xC3"), at(0xC3, 3, 2));
        for utf16 in [b"\xFF\xFEa\0".as_slice(), b"\xFE\xFF\0a"] {
            assert_eq!(text(utf16), Err(NotText::Utf16));
        }
    }

    #[test]
    fn the_problem_names_the_file_and_the_line() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x.toml");
        let problem = || {
            read_file(&path)
                .unwrap_err()
                .to_string()
                .replace(dir.path().to_str().unwrap(), "")
        };
        assert!(
            problem().ends_with("/x.toml; check the path and its permissions"),
            "{}",
            problem()
        );
        std::fs::write(&path, vec![b'#'; LONGEST as usize + 1]).unwrap();
        assert_eq!(
            problem(),
            "the file is longer than 16 MiB; /x.toml; name the intended file"
        );
        assert!(read_file(Path::new("/dev/zero")).is_err());
        std::fs::write(&path, b"a\n\xB0").unwrap();
        assert_eq!(
            problem(),
            "the file is not text: byte 0xB0 at line 2, column 1; /x.toml:2; save it as UTF-8 text, or name the intended file"
        );
    }
}
