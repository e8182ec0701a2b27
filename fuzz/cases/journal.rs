//! A segment of the MQTT buffer on disk, as a crash or a bad disk may leave it.
//!
//! Input: the segment.

use drivegate::north::mqtt::whole_records;

pub(crate) fn run(data: &[u8]) {
    let (records, bytes) = whole_records(data);
    assert!(bytes <= data.len() && records * 11 <= bytes);
    // What is whole stays whole, whatever follows it.
    assert_eq!(whole_records(&data[..bytes]), (records, bytes));
    let more = [data, &[0; 9]].concat();
    assert!(whole_records(&more).1 >= bytes);
}
