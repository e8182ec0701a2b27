//! Subscriptions and their packets.

use rumqttc::mqttbytes::QoS;
use rumqttc::mqttbytes::v5::Filter;

use super::REQUESTS;

/// Size of a packet with subscriptions, bytes, at most.
pub(super) const SUBSCRIBE_BYTES: usize = 8 << 10;
/// Filters of a packet with subscriptions, at most: AWS IoT Core closes the connection at the ninth, without a reason.
const MOST_FILTERS: usize = 8;
/// Maximum number of packets with subscriptions: the client accepts [`REQUESTS`] at a time. Beyond this number,
/// each packet contains more filters.
const MOST_PACKETS: usize = REQUESTS / 2;

/// A subscription to commands. Retained messages are requested too and stay marked, even if they arrive during the
/// subscription, so that they can be refused.
pub(crate) fn commanding(path: String) -> Filter {
    Filter {
        path,
        qos: QoS::AtLeastOnce,
        preserve_retain: true,
        ..Filter::default()
    }
}

/// A subscription without the gateway's own messages.
pub(crate) fn of_others(path: String) -> Filter {
    Filter {
        path,
        qos: QoS::AtLeastOnce,
        nolocal: true,
        ..Filter::default()
    }
}

/// Packets with these filters in their order, each of at most `most` bytes and [`MOST_FILTERS`] filters, unless there are
/// too many.
pub(super) fn packets(filters: Vec<Filter>, most: usize) -> Vec<Vec<Filter>> {
    let most_filters = MOST_FILTERS.max(filters.len().div_ceil(MOST_PACKETS));
    let mut packets: Vec<(usize, Vec<Filter>)> = Vec::new();
    for filter in filters {
        // Each filter needs its path, the length of the path and the options; each packet has a header.
        let bytes = filter.path.len() + 3;
        let has_room = |(size, packet): &&mut (usize, Vec<Filter>)| size + bytes <= most && packet.len() < most_filters;
        match packets.last_mut().filter(has_room) {
            Some((size, packet)) => {
                *size += bytes;
                packet.push(filter);
            }
            None => packets.push((bytes + 8, vec![filter])),
        }
    }
    packets.into_iter().map(|(_, packet)| packet).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_packet_with_subscriptions_has_eight_filters_and_so_many_bytes_at_most() {
        let filters = |count: usize, length: usize| -> Vec<Filter> {
            let path = |number: usize| format!("{number:0length$}");
            (0..count)
                .map(|number| Filter::new(path(number), QoS::AtLeastOnce))
                .collect()
        };
        for (count, length, most, sizes) in [
            (0, 10, 8192, vec![]),
            (8, 10, 8192, vec![8]),
            (9, 10, 8192, vec![8, 1]),
            (20, 10, 8192, vec![8, 8, 4]),
            (640, 4, 8192, vec![10; 64]),
            // Three of 103 bytes and the head of 8 fit into 320.
            (7, 100, 320, vec![3, 3, 1]),
            (2, 400, 320, vec![1, 1]),
        ] {
            let wanted = filters(count, length);
            let packets = packets(wanted.clone(), most);
            assert_eq!(
                packets.iter().map(Vec::len).collect::<Vec<_>>(),
                sizes,
                "{count} {length}"
            );
            assert_eq!(packets.concat(), wanted, "in their order");
        }
    }
}
