//! The entities of a device: one for each published point, the state, the text of the fault and the events.
//!
//! A template yields `None` for a value that is not good, which Home Assistant shows as unknown.

use serde_json::{Map, Value, json};

use super::Sources;
use crate::payload;
use drivegate_core::event::EventKind;
use drivegate_core::process_image::{Access, DriveSpec};
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::profile::Form;
use drivegate_model::drive::{ModelPoint, Point, PollClass, State};

/// Entities with their keys in the message, in order.
pub(super) type Entities = Vec<(String, Value)>;

/// The points that can be commanded from Home Assistant, if the drive has them; others are only shown.
const COMMANDS: [ModelPoint; 5] = [
    ModelPoint::Run,
    ModelPoint::Reverse,
    ModelPoint::FaultReset,
    ModelPoint::SpeedReference,
    ModelPoint::FrequencyReference,
];
/// Limits of a command in percent where neither configuration nor profile has any.
const PERCENT: (f64, f64) = (0.0, 100.0);

/// Units of counters.
const COUNTED: [&str; 7] = ["Wh", "kWh", "MWh", "varh", "kvarh", "kVAh", "m³"];
/// Abbreviations that are written in capitals in the names of entities.
const CAPITALS: [&str; 8] = ["ac", "dc", "id", "io", "pi", "pid", "pwm", "rms"];

/// A platform of Home Assistant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Platform {
    BinarySensor,
    Button,
    Event,
    Number,
    Sensor,
    Switch,
}

impl Platform {
    fn name(self) -> &'static str {
        match self {
            Platform::BinarySensor => "binary_sensor",
            Platform::Button => "button",
            Platform::Event => "event",
            Platform::Number => "number",
            Platform::Sensor => "sensor",
            Platform::Switch => "switch",
        }
    }
}

/// Available while the gateway is connected to the broker.
pub(super) fn of_gateway_availability(sources: &Sources) -> Value {
    json!([{ "t": sources.topics.status() }])
}

/// Available while the gateway is connected and the drive is not offline.
pub(super) fn of_drive_availability(sources: &Sources, spec: &DriveSpec) -> Value {
    let (topic, template) = if sources.telemetry.points {
        (
            sources.topics.point(&spec.name, "state"),
            "{{ 'offline' if value == 'offline' else 'online' }}",
        )
    } else {
        (
            sources.topics.drive(&spec.name, "state"),
            "{{ 'offline' if value_json is defined and value_json['state'] == 'offline' else 'online' }}",
        )
    };
    json!([{ "t": sources.topics.status() }, { "t": topic, "val_tpl": template }])
}

/// Entities for the health of the buses.
pub(super) fn of_gateway(sources: &Sources, id: &str, buses: &[String]) -> Entities {
    let bus_entities = |bus: &String| {
        let entity = |platform, leaf: &str, name: &str, template: &str, more: Value| {
            let always = json!({
                "name": format!("{bus} {name}"),
                "uniq_id": format!("{id}_bus_{}_{leaf}", super::id_of(bus)),
                "ent_cat": "diagnostic",
                "stat_t": sources.topics.bus(bus),
                "val_tpl": format!("{{{{ {template} if value_json is defined else none }}}}"),
            });
            component(platform, &format!("{bus}_{leaf}"), [always, more])
        };
        let measured = |unit: &str| json!({ "unit_of_meas": unit, "stat_cla": "measurement" });
        [
            entity(
                Platform::BinarySensor,
                "up",
                "connection",
                "value_json['state']",
                json!({ "dev_cla": "connectivity", "pl_on": "up", "pl_off": "down" }),
            ),
            entity(
                Platform::Sensor,
                "load",
                "load",
                "(value_json['load'] * 100) | round(1) if value_json['load'] is not none else none",
                measured("%"),
            ),
            entity(
                Platform::Sensor,
                "online",
                "drives online",
                "value_json['online']",
                json!({ "stat_cla": "measurement" }),
            ),
            entity(
                Platform::Sensor,
                "fast_cycle",
                "fast cycle",
                "value_json['fast_cycle_ms']",
                json!({ "dev_cla": "duration", "unit_of_meas": "ms", "stat_cla": "measurement" }),
            ),
            entity(
                Platform::Sensor,
                "errors",
                "errors",
                "value_json['errors']",
                json!({ "stat_cla": "total_increasing" }),
            ),
        ]
    };
    buses.iter().flat_map(bus_entities).collect()
}

/// The entities of a drive: one for each published point, and the additional ones.
pub(super) fn of_drive(sources: &Sources, id: &str, spec: &DriveSpec) -> Entities {
    let drive = DriveEntities { sources, id, spec };
    let published = payload::published_points(&spec.profile);
    let points = published
        .iter()
        .filter_map(|(index, _)| spec.profile.points.get(*index));
    let mut entities: Entities = points.map(|point| drive.of_point(point)).collect();
    // A button needs no value, so its point may be one that is never read.
    let reset = spec.profile.model_index(ModelPoint::FaultReset);
    let hidden = reset.filter(|index| published.iter().all(|(shown, _)| shown != index));
    let hidden = hidden.and_then(|index| spec.profile.points.get(index));
    entities.extend(hidden.and_then(|point| drive.command(point)));
    entities.push(drive.state());
    if spec.profile.model_index(ModelPoint::FaultCode).is_some() {
        entities.push(drive.fault_text());
    }
    entities.push(drive.events());
    entities.extend(drive.withdrawn(&entities));
    entities
}

struct DriveEntities<'d> {
    sources: &'d Sources,
    id: &'d str,
    spec: &'d DriveSpec,
}

impl DriveEntities<'_> {
    /// The entity of a point, with all of these keys.
    fn entity<const N: usize>(&self, platform: Platform, name: &str, keys: [Value; N]) -> (String, Value) {
        let own = json!({ "name": title(name), "uniq_id": format!("{}_{name}", self.id) });
        component(platform, name, std::iter::once(own).chain(keys))
    }

    /// Whether the point can be commanded from Home Assistant.
    fn is_commanded(&self, point: &Point) -> bool {
        let command = point.model.is_some_and(|model| COMMANDS.contains(&model)) && point.write;
        command && self.sources.commands && self.spec.access == Access::Control
    }

    fn of_point(&self, point: &Point) -> (String, Value) {
        self.command(point).unwrap_or_else(|| self.sensor(point))
    }

    /// The entity that controls a point, if the point can be commanded.
    fn command(&self, point: &Point) -> Option<(String, Value)> {
        if !self.is_commanded(point) || point.kind() == Kind::Text {
            return None;
        }
        let name = &point.name;
        let send = |value: &str| format!("{{\"id\": \"{{{{ now().timestamp() }}}}\", \"{name}\": {value} }}");
        let (platform, more, shown) = match point.kind() {
            Kind::Bool if point.pulse => (
                Platform::Button,
                json!({ "pl_prs": "true", "cmd_tpl": send("{{ value }}") }),
                Value::Null,
            ),
            Kind::Bool => (
                Platform::Switch,
                json!({ "pl_on": "true", "pl_off": "false", "cmd_tpl": send("{{ value }}") }),
                self.show(name, &Shown::Bool),
            ),
            Kind::Number | Kind::Integer | Kind::Text => {
                let (least, most) = self.limits(point)?;
                let mut more = json!({
                    "min": least, "max": most, "step": 0.01, "mode": "box", "unit_of_meas": point.unit,
                    "cmd_tpl": send("{{ value }}"),
                });
                extend(&mut more, device_class(&point.unit));
                (Platform::Number, more, self.show(name, &Shown::Within(least, most)))
            }
        };
        let topic = self.sources.topics.drive(&self.spec.name, "set");
        Some(self.entity(platform, name, [json!({ "cmd_t": topic, "qos": 1 }), more, shown]))
    }

    /// Limits of a command; `None` if only the drive knows them, or if they allow only one value, which Home
    /// Assistant does not accept for a number.
    fn limits(&self, point: &Point) -> Option<(f64, f64)> {
        let index = self.spec.profile.point_index(&point.name)?;
        let limits = match self.spec.limits_of(index) {
            Some(limits) => Some(limits.into_inner()),
            None => (point.unit == "%").then_some(PERCENT),
        };
        limits.filter(|(least, most)| least < most)
    }

    fn sensor(&self, point: &Point) -> (String, Value) {
        let name = &point.name;
        let category = match point.model {
            None => json!({ "ent_cat": "diagnostic" }),
            Some(_) => Value::Null,
        };
        let (shown, more) = match point.kind() {
            _ if !point.texts.is_empty() => (Shown::Texts(point), Value::Null),
            Kind::Bool => {
                let class = match point.model {
                    Some(ModelPoint::Running) => json!({ "dev_cla": "running" }),
                    Some(ModelPoint::Fault | ModelPoint::Warning) => json!({ "dev_cla": "problem" }),
                    _ => Value::Null,
                };
                let mut more = json!({ "pl_on": "true", "pl_off": "false" });
                extend(&mut more, class);
                (Shown::Bool, more)
            }
            Kind::Number => (Shown::Plain, quantity(point)),
            // A count of 64 bits, not a code.
            Kind::Integer if !point.unit.is_empty() => (Shown::Plain, quantity(point)),
            Kind::Integer | Kind::Text => (Shown::Plain, Value::Null),
        };
        self.entity(sensor_platform(point), name, [category, self.show(name, &shown), more])
    }

    /// The topic of a published value and the template that shows it.
    fn show(&self, name: &str, shown: &Shown<'_>) -> Value {
        let points = self.sources.telemetry.points;
        let topic = if points {
            self.sources.topics.point(&self.spec.name, name)
        } else {
            self.sources.topics.drive(&self.spec.name, "state")
        };
        json!({ "stat_t": topic, "val_tpl": shown.template(name, points) })
    }

    fn state(&self) -> (String, Value) {
        // The state is available for an offline drive, too.
        let available = of_gateway_availability(self.sources);
        let states: Vec<&str> = State::ALL.into_iter().map(State::name).collect();
        let more = json!({ "dev_cla": "enum", "ops": states, "avty": available });
        self.entity(Platform::Sensor, "state", [self.show("state", &Shown::Plain), more])
    }

    /// The state always has its text in a second entity, even if the code is zero: the topic of the text is then empty.
    fn fault_text(&self) -> (String, Value) {
        let topics = &self.sources.topics;
        let (topic, template) = if self.sources.telemetry.state {
            (
                topics.drive(&self.spec.name, "state"),
                "{{ (value_json['fault_text'] or 'no fault') if value_json is defined and value_json['fault_code'] is \
                 not none else none }}",
            )
        } else {
            (topics.point(&self.spec.name, "fault_text"), "{{ value or none }}")
        };
        let shown = json!({ "stat_t": topic, "val_tpl": template });
        self.entity(Platform::Sensor, "fault_text", [shown])
    }

    fn events(&self) -> (String, Value) {
        let kinds: Vec<&str> = EventKind::ALL.into_iter().map(EventKind::name).collect();
        let topic = self.sources.topics.drive(&self.spec.name, "event");
        let template = "{{ dict(value_json, event_type=value_json['event']) | to_json }}";
        let available = of_gateway_availability(self.sources);
        let all = json!({ "stat_t": topic, "evt_typ": kinds, "val_tpl": template, "qos": 1, "avty": available });
        self.entity(Platform::Event, "event", [all])
    }

    /// Removes the entities that the points of `COMMANDS` had while the drive could be commanded, or could not:
    /// such an entity is listed with its platform only.
    fn withdrawn(&self, present: &Entities) -> Entities {
        let both = COMMANDS.into_iter().flat_map(|model| {
            let point = self.spec.profile.model_point(model);
            point.into_iter().flat_map(|point| {
                let control = match point.kind() {
                    Kind::Bool if point.pulse => Platform::Button,
                    Kind::Bool => Platform::Switch,
                    Kind::Number | Kind::Integer | Kind::Text => Platform::Number,
                };
                [control, sensor_platform(point)].map(|platform| (platform, point.name.as_str()))
            })
        });
        let withdrawn = both.filter_map(|(platform, name)| {
            let key = format!("{}_{name}", platform.name());
            let absent = !present.iter().any(|(present, _)| *present == key);
            absent.then(|| (key, json!({ "p": platform.name() })))
        });
        withdrawn.collect()
    }
}

fn sensor_platform(point: &Point) -> Platform {
    match point.kind() {
        Kind::Bool if point.texts.is_empty() => Platform::BinarySensor,
        _ => Platform::Sensor,
    }
}

/// How Home Assistant displays a value.
enum Shown<'p> {
    Plain,
    Bool,
    /// A number between limits; Home Assistant would refuse another one and keep the last.
    Within(f64, f64),
    /// As the texts of an enumeration.
    Texts(&'p Point),
}

impl Shown<'_> {
    /// The template for a topic with the bare value, or for the object of the state.
    fn template(&self, name: &str, bare: bool) -> String {
        let value = if bare {
            "value or none".to_string()
        } else {
            format!("value_json['{name}'] if value_json is defined else none")
        };
        let then = match self {
            Shown::Plain => return format!("{{{{ {value} }}}}"),
            Shown::Bool if bare => return format!("{{{{ {value} }}}}"),
            Shown::Bool => "v | lower".to_string(),
            Shown::Within(least, most) => {
                return format!(
                    "{{% set v = {value} %}}{{{{ v if v is not none and {least} <= v | float <= {most} else none }}}}"
                );
            }
            Shown::Texts(point) => {
                let key = |code: &i64| match point.kind() {
                    Kind::Bool => (*code != 0).to_string(),
                    Kind::Number | Kind::Integer | Kind::Text => code.to_string(),
                };
                let texts: Map<String, Value> = point.texts.iter().map(|(c, t)| (key(c), t.as_str().into())).collect();
                format!("{}.get(v | string | lower, v)", Value::from(texts))
            }
        };
        format!("{{% set v = {value} %}}{{{{ {then} if v is not none else none }}}}")
    }
}

/// Unit and kind of a measured quantity.
fn quantity(point: &Point) -> Value {
    let mut quantity = device_class(&point.unit);
    if !point.unit.is_empty() {
        extend(&mut quantity, json!({ "unit_of_meas": point.unit }));
    }
    let counts = matches!(point.model, Some(ModelPoint::Energy | ModelPoint::OperatingHours))
        || COUNTED.contains(&point.unit.as_str());
    let class = match point.class {
        _ if counts && may_fall(point) => "total",
        _ if counts => "total_increasing",
        PollClass::Fast | PollClass::Slow => "measurement",
        PollClass::Once | PollClass::Fault | PollClass::Monitor | PollClass::Never => return quantity,
    };
    extend(&mut quantity, json!({ "stat_cla": class }));
    quantity
}

/// Whether a count may decrease, as a balance does: Home Assistant would mistake that for a meter that was reset.
fn may_fall(point: &Point) -> bool {
    match point.raw().map(|raw| raw.form) {
        Some(form) if form.is_signed() => true,
        // The energy of a drive on N2 is such a number, and never decreases.
        Some(Form::F32 | Form::F64) | None => {
            point.model.is_none() && point.range.as_ref().is_none_or(|range| *range.start() < 0.0)
        }
        Some(_) => false,
    }
}

/// The device class of Home Assistant for this unit, if there is one in all versions from 2024.12 on: Home
/// Assistant rejects the whole device if it does not know the class.
fn device_class(unit: &str) -> Value {
    let class = match unit {
        "A" | "mA" => "current",
        "V" | "mV" => "voltage",
        "Hz" | "kHz" => "frequency",
        "°C" => "temperature",
        "Wh" | "kWh" | "MWh" => "energy",
        "W" | "kW" => "power",
        "ms" | "s" | "min" | "h" | "d" => "duration",
        "bar" | "mbar" | "Pa" | "kPa" => "pressure",
        "VA" => "apparent_power",
        "var" => "reactive_power",
        "m³" => "volume",
        "m³/h" => "volume_flow_rate",
        _ => return json!({}),
    };
    json!({ "dev_cla": class })
}

/// A component of the message, with all of these keys.
fn component(platform: Platform, name: &str, keys: impl IntoIterator<Item = Value>) -> (String, Value) {
    let mut component = json!({ "p": platform.name() });
    keys.into_iter().for_each(|keys| extend(&mut component, keys));
    (format!("{}_{name}", platform.name()), component)
}

/// Adds keys to an entity, or replaces their values.
pub(super) fn extend(entity: &mut Value, more: Value) {
    if let (Value::Object(entity), Value::Object(more)) = (entity, more) {
        entity.extend(more);
    }
}

/// A name as text: `dc_link_voltage` is `DC link voltage`.
pub(super) fn title(name: &str) -> String {
    let word = |(place, word): (usize, &str)| {
        let mut letters = word.chars();
        match letters.next() {
            _ if CAPITALS.contains(&word) => word.to_uppercase(),
            Some(first) if place == 0 => first.to_uppercase().chain(letters).collect(),
            _ => word.to_string(),
        }
    };
    let words: Vec<String> = name.split('_').enumerate().map(word).collect();
    words.join(" ")
}
