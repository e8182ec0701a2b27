//! The content of change notifications (clauses 13.1, 13.6).

use std::time::Instant;

use super::cov::{Key, Reported, Subscription};
use super::reading::Failure;
use super::{Application, Server};
use crate::apdu;
use crate::encoding::Writer;
use crate::object::{Context, Device, cov_value, property};
use crate::services::{PropertyRef, Subscribe, confirmed, unconfirmed};
use crate::types::{Address, Error, ObjectId, ObjectType, PropertyId, WILDCARD};

/// Properties that cannot be subscribed to: groups of properties, clocks, and those that a notification itself changes.
const NEVER_REPORTED: [PropertyId; 6] = [
    PropertyId::ALL,
    PropertyId::REQUIRED,
    PropertyId::OPTIONAL,
    PropertyId::LOCAL_DATE,
    PropertyId::LOCAL_TIME,
    PropertyId::ACTIVE_COV_SUBSCRIPTIONS,
];
/// Longest value of a notification, because a notification is a single message.
const LONGEST: usize = 1024;

/// The properties that a subscription reports.
fn reported_properties(of: &Context<'_>, one: Option<PropertyRef>) -> Vec<PropertyRef> {
    let whole = |property: PropertyId| PropertyRef { property, index: None };
    match one {
        None => cov_value(of).iter().copied().map(whole).collect(),
        Some(one) => {
            let has_flags = matches!(of, Context::Object { .. } | Context::Port(_));
            let flags = whole(PropertyId::STATUS_FLAGS);
            [Some(one), Some(flags).filter(|flags| has_flags && *flags != one)]
                .into_iter()
                .flatten()
                .collect()
        }
    }
}

impl Server {
    pub(super) fn subscribe_to(
        &mut self,
        from: Address,
        device: &Device,
        asked: Subscribe,
        app: &dyn Application,
        now: Instant,
    ) -> Result<(), Failure> {
        let object = match asked.object {
            id if id == ObjectId::new(ObjectType::DEVICE, WILDCARD) => device.id(),
            id => id,
        };
        let key = Key {
            subscriber: from,
            process: asked.process,
            object,
            property: asked.property.map(|(property, _)| property),
        };
        let Some(terms) = asked.terms else {
            self.cov.cancel(device.instance, &key);
            return Ok(());
        };
        let known = self.with_object(device, object, app, now, |of| match key.property {
            None => Ok(()),
            Some(one) if NEVER_REPORTED.contains(&one.property) => Err(Error::NOT_COV_PROPERTY),
            Some(one) => {
                let mut value = Writer::default();
                property(&mut value, of, one, &self.environment)?;
                if value.bytes().len() <= LONGEST {
                    Ok(())
                } else {
                    Err(Error::NOT_COV_PROPERTY)
                }
            }
        });
        known.unwrap_or(Err(Error::UNKNOWN_OBJECT))?;
        let increment = asked.property.and_then(|(_, increment)| increment);
        if self.cov.subscribe(device.instance, key, terms, increment, now) {
            Ok(())
        } else {
            Err(Error::NO_SPACE_TO_ADD_LIST_ELEMENT.into())
        }
    }

    /// The present values of a subscription.
    fn shows(
        &self,
        device: &Device,
        key: &Key,
        app: &dyn Application,
        now: Instant,
    ) -> Option<(Reported, f64, Vec<u8>)> {
        self.with_object(device, key.object, app, now, |of| {
            let mut values = Writer::default();
            let mut told = Reported::default();
            let (number, flags) = of.figure();
            for one in reported_properties(of, key.property) {
                let mut value = Writer::default();
                // Values that no longer exist, or are too long now, are sent as empty.
                if property(&mut value, of, one, &self.environment).is_err() || value.bytes().len() > LONGEST {
                    value = Writer::default();
                }
                values.context_property(0, one.property);
                if let Some(index) = one.index {
                    values.context_unsigned(1, index.into());
                }
                values.open(2).raw(value.bytes()).close(2);
                match one.property {
                    PropertyId::PRESENT_VALUE if number.is_some() => told.number = number,
                    _ => told.rest.extend_from_slice(value.bytes()),
                }
            }
            told.rest.extend(flags.map(u8::from));
            let increment = match of {
                Context::Object { increment, .. } => f64::from(*increment),
                _ => 0.0,
            };
            (told, increment, values.into_bytes())
        })
    }

    /// Checks whether values of a device have changed enough to notify subscribers.
    pub(super) fn check_changes(&mut self, instance: u32, app: &dyn Application, now: Instant) {
        if self.cov.of(instance).is_empty() || self.quiet.contains_key(&instance) || !app.answers(instance) {
            return;
        }
        let Some(device) = self.device(instance) else { return };
        let mut cov = std::mem::take(&mut self.cov);
        cov.compare(instance, &mut |_, subscription: &Subscription| {
            let (told, increment, _) = self.shows(&device, &subscription.key, app, now)?;
            Some((told, increment))
        });
        self.cov = cov;
    }

    /// Sends the notifications that are due.
    pub(super) fn notify(&mut self, app: &dyn Application, now: Instant) {
        while let Some((instance, key, confirmed)) = self.cov.next(|device| self.quiet.contains_key(&device)) {
            let device = self.device(instance).filter(|_| app.answers(instance));
            let shows = device.and_then(|device| Some((self.shows(&device, &key, app, now)?, device)));
            let Some(((told, _, values), device)) = shows else {
                self.cov.notified(instance, &key, None);
                continue;
            };
            let subscription = self.cov.of(instance).iter().find(|s| s.key == key);
            let left = subscription.map_or(0, |subscription| subscription.left(now));
            let mut content = Writer::default();
            content
                .context_unsigned(0, key.process.into())
                .context_object(1, device.id());
            content.context_object(2, key.object).context_unsigned(3, left);
            content.open(4).raw(&values).close(4);
            self.cov.notified(instance, &key, Some(told));
            self.counters.notifications += 1;
            if confirmed {
                let invoke = self.cov.number();
                let apdu = apdu::confirmed(invoke, confirmed::COV_NOTIFICATION, content.bytes());
                self.cov.sent(instance, key, invoke, apdu.clone(), now);
                self.send_exempt(key.subscriber, instance, &apdu, true);
            } else {
                let apdu = apdu::unconfirmed(unconfirmed::COV_NOTIFICATION, content.bytes());
                self.send_exempt(key.subscriber, instance, &apdu, false);
            }
        }
    }

    /// Writes the property Active_COV_Subscriptions.
    pub(super) fn list_subscriptions(&self, instance: u32, out: &mut Writer, now: Instant) {
        for subscription in self.cov.of(instance) {
            let key = &subscription.key;
            out.open(0).open(0).open(1);
            match &key.subscriber.remote {
                None => out.unsigned(0).octets(&Address::host_octets(key.subscriber.host)),
                Some((network, mac)) => out.unsigned((*network).into()).octets(mac.octets()),
            };
            out.close(1).close(0).context_unsigned(1, key.process.into()).close(0);
            let one = key.property.map_or(PropertyId::PRESENT_VALUE, |one| one.property);
            out.open(1).context_object(0, key.object).context_property(1, one);
            if let Some(index) = key.property.and_then(|one| one.index) {
                out.context_unsigned(2, index.into());
            }
            out.close(1).context_bool(2, subscription.confirmed);
            out.context_unsigned(3, subscription.left(now));
            if let Some(increment) = subscription.increment {
                out.context_real(4, increment);
            }
        }
    }
}
