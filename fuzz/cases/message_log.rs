//! A file of the MQTT buffer in any state in which a crash or a bad disk may leave it.
//!
//! Input: the journal file.

use drivegate_mqtt::whole_records;

pub(crate) fn run(data: &[u8]) {
    let (records, bytes) = whole_records(data);
    assert!(bytes <= data.len() && records * 21 <= bytes);
    // Complete records stay readable, whatever precedes them.
    let more = [&[0; 9][..], data].concat();
    assert_eq!(whole_records(&more), (records, bytes));
}
