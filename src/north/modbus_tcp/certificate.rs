//! What the gateway itself reads in an X.509 certificate: subject, validity, role. Pure.
//!
//! Trust is rustls' business: a client's certificate comes here after its chain and its signature were checked.
//! The reader takes DER as far as these fields need it and gives up on anything else.

/// 1.3.6.1.4.1.50316.802.1, the role of a client (Modbus/TCP Security protocol specification, 8.4).
const ROLE: [u8; 11] = [0x2B, 6, 1, 4, 1, 0x83, 0x89, 0x0C, 0x86, 0x22, 1];
/// 2.5.4.3, common name.
const COMMON_NAME: [u8; 3] = [0x55, 4, 3];
/// Most characters of a name in the log.
const NAME: usize = 64;

const BOOLEAN: u8 = 0x01;
const INTEGER: u8 = 0x02;
const OCTETS: u8 = 0x04;
const OID: u8 = 0x06;
const UTF8: u8 = 0x0C;
const PRINTABLE: u8 = 0x13;
const IA5: u8 = 0x16;
const UTC_TIME: u8 = 0x17;
const GENERALIZED_TIME: u8 = 0x18;
const SEQUENCE: u8 = 0x30;
const SET: u8 = 0x31;
const VERSION: u8 = 0xA0;
const EXTENSIONS: u8 = 0xA3;

/// What a certificate tells.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct CertificateSummary {
    /// Common name of the subject, else the serial number; printable, of bounded length.
    pub(super) name: String,
    /// Seconds since 1970; before 1970 is 0.
    pub(super) not_before: u64,
    /// Seconds since 1970.
    pub(super) not_after: u64,
    /// Role of a Modbus client.
    pub(super) role: Option<String>,
}

/// Reads a certificate; `None` when it is none.
pub(super) fn read(der: &[u8]) -> Option<CertificateSummary> {
    let mut certificate = Der(Der(der).take(SEQUENCE)?);
    let mut fields = Der(certificate.take(SEQUENCE)?);
    fields.take(VERSION);
    let serial = fields.take(INTEGER)?;
    fields.take(SEQUENCE)?; // signature algorithm
    fields.take(SEQUENCE)?; // issuer
    let mut validity = Der(fields.take(SEQUENCE)?);
    let (not_before, not_after) = (time(&mut validity)?, time(&mut validity)?);
    let subject = fields.take(SEQUENCE)?;
    fields.take(SEQUENCE)?; // public key
    let mut role = None;
    while let Some((tag, content)) = fields.next() {
        if tag == EXTENSIONS {
            role = role_of(Der(Der(content).take(SEQUENCE)?));
        }
    }
    Some(CertificateSummary {
        name: common_name(Der(subject)).unwrap_or_else(|| format!("serial {}", hex(serial))),
        not_before,
        not_after,
        role,
    })
}

/// Elements one after the other.
struct Der<'d>(&'d [u8]);

impl<'d> Der<'d> {
    /// Tag and content of the next element.
    fn next(&mut self) -> Option<(u8, &'d [u8])> {
        let [tag, length, rest @ ..] = self.0 else { return None };
        let (length, rest) = match *length {
            short @ 0..0x80 => (usize::from(short), rest),
            long => {
                let digits = usize::from(long & 0x7F);
                let (length, rest) = rest.split_at_checked(digits).filter(|_| (1..=4).contains(&digits))?;
                let length = length.iter().fold(0usize, |sum, digit| sum << 8 | usize::from(*digit));
                (length, rest)
            }
        };
        let (content, rest) = rest.split_at_checked(length)?;
        self.0 = rest;
        Some((*tag, content))
    }

    /// The content of the next element if it has that tag; else nothing is taken.
    fn take(&mut self, tag: u8) -> Option<&'d [u8]> {
        let mut ahead = Der(self.0);
        let (found, content) = ahead.next()?;
        (found == tag).then(|| {
            self.0 = ahead.0;
            content
        })
    }
}

fn role_of(mut extensions: Der<'_>) -> Option<String> {
    while let Some(extension) = extensions.take(SEQUENCE) {
        let mut extension = Der(extension);
        if extension.take(OID)? != ROLE {
            continue;
        }
        extension.take(BOOLEAN); // critical
        let text = Der(extension.take(OCTETS)?).take(UTF8)?;
        return String::from_utf8(text.to_vec()).ok();
    }
    None
}

fn common_name(mut subject: Der<'_>) -> Option<String> {
    while let Some(set) = subject.take(SET) {
        let mut attribute = Der(Der(set).take(SEQUENCE)?);
        if attribute.take(OID)? != COMMON_NAME {
            continue;
        }
        let (tag, text) = attribute.next()?;
        let text = String::from_utf8_lossy(text);
        return [UTF8, PRINTABLE, IA5].contains(&tag).then(|| printable(&text));
    }
    None
}

/// For the log and the audit: nothing that could be taken for another line or another field.
pub(super) fn printable(text: &str) -> String {
    let safe = |c: char| {
        if c.is_alphanumeric() || " .-_@:/+".contains(c) {
            c
        } else {
            '?'
        }
    };
    text.chars().take(NAME).map(safe).collect()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().take(NAME / 2).map(|byte| format!("{byte:02x}")).collect()
}

/// Seconds since 1970 of a UTCTime (`YYMMDDhhmmssZ`, 1950 to 2049) or a GeneralizedTime (`YYYYMMDDhhmmssZ`).
fn time(fields: &mut Der<'_>) -> Option<u64> {
    let (tag, text) = fields.next()?;
    let text = std::str::from_utf8(text).ok()?.strip_suffix('Z')?;
    let (year, rest) = match tag {
        UTC_TIME => text.split_at_checked(2)?,
        GENERALIZED_TIME => text.split_at_checked(4)?,
        _ => return None,
    };
    let year: i64 = year.parse().ok()?;
    let year = match (tag, year) {
        (UTC_TIME, 0..50) => year + 2000,
        (UTC_TIME, _) => year + 1900,
        _ => year,
    };
    if rest.len() != 10 || !rest.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    let two = |at: usize| rest.get(at..at + 2)?.parse::<i64>().ok();
    let [month, day, hour, minute, second] = [two(0)?, two(2)?, two(4)?, two(6)?, two(8)?];
    let seconds = days(year, month, day) * 86_400 + hour * 3600 + minute * 60 + second;
    Some(u64::try_from(seconds).unwrap_or(0))
}

/// Days from 1970-01-01, in the Gregorian calendar, whose year is counted from March here.
fn days(year: i64, month: i64, day: i64) -> i64 {
    let (year, month) = if month > 2 {
        (year, month - 3)
    } else {
        (year - 1, month + 9)
    };
    let day_of_year = (153 * month + 2) / 5 + day - 1;
    year * 365 + year.div_euclid(4) - year.div_euclid(100) + year.div_euclid(400) + day_of_year - 719_468
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const LEAP_DAY: u64 = 2_592_820_800;

    fn element(tag: u8, content: &[u8]) -> Vec<u8> {
        let length = content.len();
        let head = match length {
            0..0x80 => vec![tag, length as u8],
            _ => vec![tag, 0x82, (length >> 8) as u8, length as u8],
        };
        [head, content.to_vec()].concat()
    }

    fn sequence(parts: &[Vec<u8>]) -> Vec<u8> {
        element(SEQUENCE, &parts.concat())
    }

    fn certificate(subject: &[u8], extensions: &[Vec<u8>]) -> Vec<u8> {
        let validity = sequence(&[
            element(UTC_TIME, b"260101000000Z"),
            element(GENERALIZED_TIME, b"20520229120000Z"),
        ]);
        let fields = sequence(&[
            element(VERSION, &element(INTEGER, &[2])),
            element(INTEGER, &[0x0A, 0xBC]),
            sequence(&[]),
            sequence(&[]),
            validity,
            subject.to_vec(),
            sequence(&[]),
            element(EXTENSIONS, &sequence(extensions)),
        ]);
        sequence(&[fields, sequence(&[]), element(3, &[0])])
    }

    fn name(tag: u8, text: &[u8]) -> Vec<u8> {
        let attribute =
            |oid: &[u8], tag, text: &[u8]| element(SET, &sequence(&[element(OID, oid), element(tag, text)]));
        sequence(&[
            attribute(&[0x55, 4, 10], UTF8, b"Works"),
            attribute(&COMMON_NAME, tag, text),
        ])
    }

    fn role(value: &[u8]) -> Vec<u8> {
        sequence(&[element(OID, &ROLE), element(OCTETS, value)])
    }

    #[test]
    fn subject_validity_and_role() {
        let usage = sequence(&[
            element(OID, &[0x55, 0x1D, 0x0F]),
            element(BOOLEAN, &[0xFF]),
            element(OCTETS, &[3]),
        ]);
        let facts = read(&certificate(
            &name(UTF8, "hmi 1".as_bytes()),
            &[usage, role(&element(UTF8, b"operator"))],
        ));
        let facts = facts.unwrap();
        assert_eq!(
            (facts.name.as_str(), facts.role.as_deref()),
            ("hmi 1", Some("operator"))
        );
        // `date -u -d 2026-01-01 +%s`, `date -u -d '2052-02-29 12:00' +%s`
        assert_eq!((facts.not_before, facts.not_after), (1_767_225_600, LEAP_DAY));
    }

    #[test]
    fn a_role_is_a_utf8_string_and_nothing_else() {
        for value in [
            &b"operator"[..],
            &element(PRINTABLE, b"operator"),
            &element(UTF8, &[0xFF]),
            &[UTF8, 9, b'x'],
            &[],
        ] {
            let facts = read(&certificate(&name(PRINTABLE, b"x"), &[role(value)])).unwrap();
            assert_eq!(facts.role, None, "{value:?}");
        }
    }

    #[test]
    fn names_cannot_forge_log_lines() {
        let long = "x".repeat(500);
        for (text, shown) in [
            ("a\nb\" who=root", "a?b? who?root"),
            ("Müller", "Müller"),
            (&long, &long[..NAME]),
        ] {
            assert_eq!(
                read(&certificate(&name(UTF8, text.as_bytes()), &[])).unwrap().name,
                shown
            );
        }
        let nameless = read(&certificate(&sequence(&[]), &[])).unwrap();
        assert_eq!(nameless.name, "serial 0abc");
    }

    proptest! {
        #[test]
        fn any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = read(&bytes);
        }

        #[test]
        fn a_bad_byte(place in 0usize..400, byte: u8) {
            let mut der = certificate(&name(UTF8, b"hmi"), &[role(&element(UTF8, b"operator"))]);
            let place = place % der.len();
            der[place] = byte;
            let _ = read(&der);
        }
    }
}
