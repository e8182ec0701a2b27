//! Function 43/14: device identification of the units.

use drivegate_proto::{Exception, Reply};

/// Maximum length of the text of an object, so that six objects fit into one reply.
const MAX_TEXT: usize = 40;
/// Basic and regular objects, both as single objects and as a stream.
const CONFORMITY: u8 = 0x82;
/// Codes of "read device id" in function 43.
const BASIC: u8 = 1;
const REGULAR: u8 = 2;
const EXTENDED: u8 = 3;
const SINGLE: u8 = 4;
/// Last object of the basic and of the regular category.
const LAST_BASIC: u8 = 2;
const LAST_REGULAR: u8 = 0x7F;

/// VendorName of every unit.
const VENDOR: &str = "drivegate";

/// The identification data of a unit.
#[derive(Debug)]
pub(super) struct Identity<'t> {
    /// ProductCode: name of the profile, or `gateway`.
    pub(super) product: &'t str,
    /// ProductName: the title of the profile, with a note where the profile is doubtful.
    pub(super) title: &'t str,
    /// ModelName: name of the drive or of the gateway.
    pub(super) name: &'t str,
}

impl Identity<'_> {
    /// The reply to read device id code `code`, starting at `object`. Without extended objects, code 3 returns the
    /// regular ones; a stream that starts at an unknown object begins with the first one (Modbus Application Protocol
    /// 1.1b3, 6.21).
    ///
    /// # Errors
    /// Exception 03 for a code other than 1 to 4, exception 02 for a single object that does not exist.
    pub(super) fn reply(&self, code: u8, object: u8) -> Result<Reply, Exception> {
        let objects = [
            (0, VENDOR),
            (1, self.product),
            (2, drivegate_core::version::VERSION),
            (4, self.title),
            (5, self.name),
        ];
        let known = objects.iter().any(|(id, _)| *id == object);
        let last = match code {
            BASIC => LAST_BASIC,
            REGULAR => LAST_REGULAR,
            _ => u8::MAX,
        };
        let wanted: Vec<(u8, &str)> = match code {
            BASIC | REGULAR | EXTENDED => {
                let first = if known && object <= last { object } else { 0 };
                let in_stream = |id: u8| (first..=last).contains(&id);
                objects.into_iter().filter(|(id, _)| in_stream(*id)).collect()
            }
            SINGLE if known => objects.into_iter().filter(|(id, _)| *id == object).collect(),
            SINGLE => return Err(Exception::ADDRESS),
            _ => return Err(Exception::VALUE),
        };
        // "More follows" and "next object" are 0.
        let mut body = vec![code, CONFORMITY, 0, 0, wanted.len() as u8];
        for (id, text) in wanted {
            let text = ascii(text);
            body.extend_from_slice(&[id, text.len() as u8]);
            body.extend_from_slice(&text);
        }
        Ok(Reply::DeviceIdentification(body))
    }
}

/// Texts of objects are ASCII.
fn ascii(text: &str) -> Vec<u8> {
    let one = |c: char| {
        if c.is_ascii_graphic() || c == ' ' {
            c as u8
        } else {
            b'?'
        }
    };
    text.chars().take(MAX_TEXT).map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_proto::RequestPdu;
    use drivegate_proto::modbus::MAX_PDU;

    const NX: Identity<'static> = Identity {
        product: "vacon-nx",
        title: "Vacon NX",
        name: "pump-1",
    };

    /// Ids and texts of the objects in a reply.
    fn objects(code: u8, object: u8) -> Result<Vec<(u8, String)>, Exception> {
        let Reply::DeviceIdentification(body) = NX.reply(code, object)? else {
            panic!("not an identification");
        };
        assert_eq!(body[..4], [code, 0x82, 0, 0]);
        let (mut rest, mut found) = (&body[5..], Vec::new());
        while let [id, len, tail @ ..] = rest {
            let (text, tail) = tail.split_at(usize::from(*len));
            found.push((*id, String::from_utf8(text.to_vec()).unwrap()));
            rest = tail;
        }
        assert_eq!(usize::from(body[4]), found.len());
        Ok(found)
    }

    fn ids(code: u8, object: u8) -> Vec<u8> {
        objects(code, object).unwrap().iter().map(|(id, _)| *id).collect()
    }

    #[test]
    fn streams_and_single_objects() {
        assert_eq!(ids(1, 0), [0, 1, 2]);
        assert_eq!(ids(1, 1), [1, 2]);
        assert_eq!(ids(1, 4), [0, 1, 2], "not in the basic category: from the first");
        assert_eq!(ids(2, 0), [0, 1, 2, 4, 5]);
        assert_eq!(ids(2, 4), [4, 5]);
        assert_eq!(ids(3, 0x80), [0, 1, 2, 4, 5], "extended: as far as there is");
        assert_eq!(objects(4, 1), Ok(vec![(1, "vacon-nx".to_string())]));
        assert_eq!(objects(4, 5), Ok(vec![(5, "pump-1".to_string())]));
    }

    #[test]
    fn refused() {
        assert_eq!(objects(4, 3), Err(Exception::ADDRESS));
        assert_eq!(objects(0, 0), Err(Exception::VALUE));
        assert_eq!(objects(5, 0), Err(Exception::VALUE));
    }

    #[test]
    fn long_names_fit_one_pdu() {
        let long = "ü".repeat(400);
        let identity = Identity {
            product: &long,
            title: &long,
            name: &long,
        };
        let request = RequestPdu::DeviceIdentification { code: 3, object: 0 };
        let mut pdu = Vec::new();
        identity.reply(3, 0).unwrap().encode(&request, &mut pdu);
        assert!(pdu.len() <= MAX_PDU, "{}", pdu.len());
    }
}
