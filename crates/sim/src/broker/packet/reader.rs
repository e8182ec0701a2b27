//! The fields of a packet, one after the other.

use super::super::topic;
use super::{Fault, Qos, Subscription, Version, malformed, property, protocol, reason};

/// Properties of one packet that mean something here.
#[derive(Debug, Default)]
pub(super) struct Properties {
    numbers: Vec<(u8, u32)>,
    seen: u64,
    /// Properties for subscribers, encoded as they were received.
    pub(super) forwarded: Vec<u8>,
}

impl Properties {
    pub(super) fn number(&self, id: u8) -> Option<u32> {
        self.numbers.iter().find(|(known, _)| *known == id).map(|(_, n)| *n)
    }

    pub(super) fn has(&self, id: u8) -> bool {
        self.seen & (1 << id) != 0
    }
}

/// The bytes of a packet that are still to be read.
pub(super) struct Reader<'a>(pub(super) &'a [u8]);

impl<'a> Reader<'a> {
    pub(super) fn take(&mut self, count: usize) -> Result<&'a [u8], Fault> {
        let (taken, rest) = self.0.split_at_checked(count).ok_or(malformed("packet ends early"))?;
        self.0 = rest;
        Ok(taken)
    }

    pub(super) fn number(&mut self, bytes: usize) -> Result<u32, Fault> {
        let bytes = self.take(bytes)?;
        Ok(bytes.iter().fold(0, |number, byte| (number << 8) | u32::from(*byte)))
    }

    pub(super) fn u8(&mut self) -> Result<u8, Fault> {
        self.number(1).map(|number| number as u8)
    }

    pub(super) fn u16(&mut self) -> Result<u16, Fault> {
        self.number(2).map(|number| number as u16)
    }

    /// Variable byte integer, of four bytes at most.
    pub(super) fn variable(&mut self) -> Result<u32, Fault> {
        let mut value = 0;
        for index in 0..4 {
            let byte = self.u8()?;
            value |= u32::from(byte & 0x7F) << (7 * index);
            if byte & 0x80 == 0 {
                return Ok(value);
            }
        }
        Err(malformed("variable byte integer of more than four bytes"))
    }

    pub(super) fn binary(&mut self) -> Result<&'a [u8], Fault> {
        let length = self.u16()?;
        self.take(length.into())
    }

    pub(super) fn text(&mut self) -> Result<String, Fault> {
        let text = std::str::from_utf8(self.binary()?)
            .ok()
            .filter(|text| !text.contains('\0'));
        text.map(str::to_string).ok_or(malformed("text is not valid UTF-8"))
    }

    pub(super) fn packet_id(&mut self) -> Result<u16, Fault> {
        match self.u16()? {
            0 => Err(malformed("packet identifier 0")),
            pkid => Ok(pkid),
        }
    }

    /// Items until the end of the packet, at least one.
    pub(super) fn list<T>(&mut self, item: impl Fn(&mut Self) -> Result<T, Fault>) -> Result<Vec<T>, Fault> {
        let mut items = vec![item(self)?];
        while !self.0.is_empty() {
            items.push(item(self)?);
        }
        Ok(items)
    }

    pub(super) fn subscription(&mut self, version: Version) -> Result<Subscription, Fault> {
        let filter = self.text()?;
        let options = self.u8()?;
        let reserved = match version {
            Version::V311 => 0xFC,
            Version::V5 => 0xC0,
        };
        let retain_handling = (options >> 4) & 3;
        if options & 3 == 3 || retain_handling == 3 || options & reserved != 0 {
            return Err(malformed("options of a subscription"));
        }
        Ok(Subscription {
            filter,
            qos: Qos::of(options & 3),
            no_local: options & 4 != 0,
            retain_as_published: options & 8 != 0,
            retain_handling,
        })
    }

    /// Reason code and properties; v5 may omit trailing ones, and 3.1.1 has neither.
    pub(super) fn reason(&mut self, version: Version, allowed: &[u8]) -> Result<u8, Fault> {
        if version == Version::V311 || self.0.is_empty() {
            return Ok(reason::SUCCESS);
        }
        let reason = self.u8()?;
        if !self.0.is_empty() {
            self.properties(version, allowed)?;
        }
        Ok(reason)
    }

    /// The property section, which 3.1.1 does not have.
    pub(super) fn properties(&mut self, version: Version, allowed: &[u8]) -> Result<Properties, Fault> {
        let mut found = Properties::default();
        if version == Version::V311 {
            return Ok(found);
        }
        let length = self.variable()?;
        let mut section = Reader(self.take(length as usize)?);
        while !section.0.is_empty() {
            let whole = section.0;
            let id = section.u8()?;
            if !allowed.contains(&id) {
                return Err(protocol("property that does not belong to the packet"));
            }
            if found.has(id) && id != property::USER {
                return Err(protocol("property that occurs twice"));
            }
            found.seen |= 1 << id;
            section.value(id, &mut found)?;
            if property::FORWARDED.contains(&id) {
                let length = whole.len() - section.0.len();
                found
                    .forwarded
                    .extend_from_slice(whole.get(..length).unwrap_or_default());
            }
        }
        Ok(found)
    }

    pub(super) fn value(&mut self, id: u8, found: &mut Properties) -> Result<(), Fault> {
        let number = match id {
            1 | 23 | 25 => self.number(1)?,
            33..=35 => self.number(2)?,
            2 | 17 | 24 | 39 => self.number(4)?,
            11 => self.variable()?,
            9 | 22 => return self.binary().map(drop),
            property::USER => return self.text().and_then(|_| self.text()).map(drop),
            property::RESPONSE_TOPIC if topic::is_name(&self.text()?) => return Ok(()),
            property::RESPONSE_TOPIC => return Err(protocol("response topic with a wildcard")),
            // These are content type, authentication method, reason string.
            _ => return self.text().map(drop),
        };
        found.numbers.push((id, number));
        Ok(())
    }

    pub(super) fn end(&self) -> Result<(), Fault> {
        if self.0.is_empty() {
            Ok(())
        } else {
            Err(malformed("packet goes on after its end"))
        }
    }
}
