//! Function 43/14: device identification of the units.

use crate::codec::{Exception, Reply};
use crate::drive::profile::Digest;

/// Maximum length of the text of an object: six of them fit into one reply.
const MAX_TEXT: usize = 40;
/// Conformity levels: basic and regular objects, or extended ones as well; both as single objects and as a stream.
const CONFORMITY_REGULAR: u8 = 0x82;
const CONFORMITY_EXTENDED: u8 = 0x83;
/// Read device id codes.
const BASIC: u8 = 1;
const REGULAR: u8 = 2;
const EXTENDED: u8 = 3;
const SINGLE: u8 = 4;
/// Last object of the basic and of the regular category.
const LAST_BASIC: u8 = 2;
const LAST_REGULAR: u8 = 0x7F;

/// VendorName of every unit.
pub(crate) const VENDOR: &str = "drivegate";
/// Objects by which another drivegate recognises a unit.
pub(crate) const VENDOR_NAME: u8 = 0;
pub(crate) const PRODUCT_CODE: u8 = 1;
pub(crate) const MODEL_NAME: u8 = 5;
pub(crate) const PROFILE_DIGEST: u8 = 0x80;

/// The identification of a unit.
#[derive(Debug)]
pub(super) struct Identity<'t> {
    /// ProductCode: name of the profile, or `gateway`.
    pub(super) product: &'t str,
    /// ProductName: title of the profile.
    pub(super) title: &'t str,
    /// ModelName: name of the drive or of the gateway.
    pub(super) name: &'t str,
    /// Private object 0x80 of a drive: digest of the profile's content.
    pub(super) digest: Option<Digest>,
}

impl Identity<'_> {
    /// The reply to read device id code `code`, starting at `object`. Without extended objects, code 3 returns the
    /// regular ones; a stream that starts at an unknown object begins with the first one (Modbus Application Protocol
    /// 1.1b3, 6.21).
    ///
    /// # Errors
    /// 03 for a code other than 1 to 4, 02 for a single object that does not exist.
    pub(super) fn reply(&self, code: u8, object: u8) -> Result<Reply, Exception> {
        let digest = self.digest.map(|digest| digest.to_string());
        let objects = [
            (VENDOR_NAME, VENDOR),
            (PRODUCT_CODE, self.product),
            (2, env!("CARGO_PKG_VERSION")),
            (4, self.title),
            (MODEL_NAME, self.name),
        ];
        let digest = digest.as_deref().map(|digest| (PROFILE_DIGEST, digest));
        let conformity = digest.map_or(CONFORMITY_REGULAR, |_| CONFORMITY_EXTENDED);
        let objects = || objects.into_iter().chain(digest);
        let known = objects().any(|(id, _)| id == object);
        let last = match code {
            BASIC => LAST_BASIC,
            REGULAR => LAST_REGULAR,
            _ => u8::MAX,
        };
        let wanted: Vec<(u8, &str)> = match code {
            BASIC | REGULAR | EXTENDED => {
                let first = if known && object <= last { object } else { 0 };
                let in_stream = |id: u8| (first..=last).contains(&id);
                objects().filter(|(id, _)| in_stream(*id)).collect()
            }
            SINGLE if known => objects().filter(|(id, _)| *id == object).collect(),
            SINGLE => return Err(Exception::ADDRESS),
            _ => return Err(Exception::VALUE),
        };
        // "More follows" and "next object" are 0.
        let mut body = vec![code, conformity, 0, 0, wanted.len() as u8];
        for (id, text) in wanted {
            let text = ascii(text);
            body.extend_from_slice(&[id, text.len() as u8]);
            body.extend_from_slice(&text);
        }
        Ok(Reply::DeviceIdentification(body))
    }
}

/// A text as it is transmitted in an object.
pub(crate) fn as_told(text: &str) -> String {
    ascii(text).into_iter().map(char::from).collect()
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
    use crate::codec::RequestPdu;
    use crate::codec::modbus::MAX_PDU;

    const NX: Identity<'static> = Identity {
        product: "vacon-nx",
        title: "Vacon NX",
        name: "pump-1",
        digest: None,
    };

    /// Ids and texts in a reply.
    fn objects(code: u8, object: u8) -> Result<Vec<(u8, String)>, Exception> {
        objects_of(&NX, 0x82, code, object)
    }

    fn objects_of(
        identity: &Identity<'_>,
        conformity: u8,
        code: u8,
        object: u8,
    ) -> Result<Vec<(u8, String)>, Exception> {
        let Reply::DeviceIdentification(body) = identity.reply(code, object)? else {
            panic!("not an identification");
        };
        assert_eq!(body[..4], [code, conformity, 0, 0]);
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
    fn the_digest_is_an_extended_object() {
        let drive = Identity {
            digest: Some(Digest::default()),
            ..NX
        };
        let ids = |code, object| -> Vec<u8> {
            let objects = objects_of(&drive, 0x83, code, object).unwrap();
            objects.iter().map(|(id, _)| *id).collect()
        };
        assert_eq!(ids(1, 0), [0, 1, 2]);
        assert_eq!(ids(2, 0), [0, 1, 2, 4, 5]);
        assert_eq!(ids(2, 0x80), [0, 1, 2, 4, 5], "not regular: from the first");
        assert_eq!(ids(3, 0), [0, 1, 2, 4, 5, 0x80]);
        assert_eq!(ids(3, 0x80), [0x80]);
        let digest = "0000000000000000".to_string();
        assert_eq!(objects_of(&drive, 0x83, 4, 0x80), Ok(vec![(0x80, digest)]));
        assert_eq!(objects(4, 0x80), Err(Exception::ADDRESS), "the gateway has no profile");
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
            digest: Some(Digest::default()),
        };
        let request = RequestPdu::DeviceIdentification { code: 3, object: 0 };
        let mut pdu = Vec::new();
        identity.reply(3, 0).unwrap().encode(&request, &mut pdu);
        assert!(pdu.len() <= MAX_PDU, "{}", pdu.len());
    }
}
