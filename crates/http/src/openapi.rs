//! The routes together with their OpenAPI description: everything that is served is described.

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

use axum::Router;
use axum::handler::Handler;
use axum::http::header::CONTENT_TYPE;
use axum::routing::{MethodRouter, delete, get, post};
use utoipa::ToSchema;
use utoipa::openapi::path::{HttpMethod, OperationBuilder, ParameterBuilder, ParameterIn};
use utoipa::openapi::request_body::RequestBodyBuilder;
use utoipa::openapi::schema::{ArrayBuilder, Components, Schema, SchemaType, Type};
use utoipa::openapi::{
    ContentBuilder, InfoBuilder, ObjectBuilder, OneOfBuilder, OpenApiBuilder, Paths, Ref, RefOr, Required,
    ResponseBuilder,
};

use super::app_state::AppState;
use super::messages::ErrorReply;

/// Path of the API description.
pub(super) const PATH: &str = "/api/v1/openapi.json";

const JSON: &str = "application/json";

/// Failure replies with their description; the last two only for requests that reach a drive.
const FAILURES: [(&str, &str); 4] = [
    ("4XX", "refused, and why"),
    (
        "503",
        "not carried out: the gateway, the bus or the drive does not serve it now",
    ),
    ("502", "the drive refused it, or its reply was not valid"),
    ("504", "what became of it is not known, or not all of it is"),
];

/// The routes added so far, with their OpenAPI description.
pub(super) struct Api {
    router: Router<Arc<AppState>>,
    paths: Paths,
    schemas: Schemas,
}

type Schemas = BTreeMap<String, RefOr<Schema>>;

/// The OpenAPI description of a route.
pub(super) struct Doc {
    summary: &'static str,
    query: &'static [(&'static str, &'static str)],
    body: Option<RefOr<Schema>>,
    content_type: &'static str,
    reply: Option<RefOr<Schema>>,
    /// Body of a failure reply, unless the request itself was invalid.
    failure: Option<RefOr<Schema>>,
    schemas: Vec<(String, RefOr<Schema>)>,
}

/// A reference to the schema of a type; adds that schema and all schemas it needs.
fn schema_of<T: ToSchema>(schemas: &mut Vec<(String, RefOr<Schema>)>) -> RefOr<Schema> {
    let name = T::name().into_owned();
    schemas.push((name.clone(), T::schema()));
    T::schemas(schemas);
    RefOr::Ref(Ref::from_schema_name(name))
}

fn any() -> RefOr<Schema> {
    ObjectBuilder::new().schema_type(SchemaType::AnyValue).into()
}

fn schema_of_list<T: ToSchema>(schemas: &mut Vec<(String, RefOr<Schema>)>) -> RefOr<Schema> {
    ArrayBuilder::new().items(schema_of::<T>(schemas)).build().into()
}

impl Doc {
    /// A route that replies with a text of that type.
    pub(super) fn text(summary: &'static str, content_type: &'static str) -> Doc {
        Doc {
            summary,
            query: &[],
            body: None,
            content_type,
            reply: None,
            failure: None,
            schemas: Vec::new(),
        }
    }

    /// A route that replies with an object.
    pub(super) fn object<T: ToSchema>(summary: &'static str) -> Doc {
        let mut doc = Doc::text(summary, JSON);
        doc.reply = Some(schema_of::<T>(&mut doc.schemas));
        doc
    }

    /// A route that replies with a list of objects.
    pub(super) fn list<T: ToSchema>(summary: &'static str) -> Doc {
        let mut doc = Doc::text(summary, JSON);
        doc.reply = Some(schema_of_list::<T>(&mut doc.schemas));
        doc
    }

    /// The route may reply with an object of that type instead.
    pub(super) fn or<T: ToSchema>(mut self) -> Doc {
        let other = schema_of::<T>(&mut self.schemas);
        self.or_schema(other)
    }

    /// Documents that the route may also reply with a list of such objects.
    pub(super) fn or_list<T: ToSchema>(mut self) -> Doc {
        let other = schema_of_list::<T>(&mut self.schemas);
        self.or_schema(other)
    }

    fn or_schema(self, other: RefOr<Schema>) -> Doc {
        let replies = OneOfBuilder::new();
        let replies = match self.reply {
            Some(RefOr::T(Schema::OneOf(before))) => before.items.into_iter().fold(replies, OneOfBuilder::item),
            Some(before) => replies.item(before),
            None => replies,
        };
        Doc {
            reply: Some(RefOr::T(Schema::OneOf(replies.item(other).build()))),
            ..self
        }
    }

    /// A route that replies with JSON of several forms.
    pub(super) fn any(summary: &'static str) -> Doc {
        let mut doc = Doc::text(summary, JSON);
        doc.reply = Some(any());
        doc
    }

    /// Documents that a valid request which could not be carried out is answered with this object.
    pub(super) fn failing_with<T: ToSchema>(mut self) -> Doc {
        self.failure = Some(schema_of::<T>(&mut self.schemas));
        self
    }

    /// Describes a body that is an object whose fields depend on the drive.
    pub(super) fn any_body(self) -> Doc {
        Doc {
            body: Some(any()),
            ..self
        }
    }

    /// Describes these parameters of the query, each optional.
    pub(super) fn query(self, query: &'static [(&'static str, &'static str)]) -> Doc {
        Doc { query, ..self }
    }

    /// Describes a body that is an object of type `T`.
    pub(super) fn body<T: ToSchema>(mut self) -> Doc {
        self.body = Some(schema_of::<T>(&mut self.schemas));
        self
    }
}

impl Api {
    pub(super) fn new() -> Api {
        let mut api = Api {
            router: Router::new(),
            paths: Paths::new(),
            schemas: Schemas::new(),
        };
        let mut schemas = Vec::new();
        schema_of::<ErrorReply>(&mut schemas);
        api.schemas.extend(schemas);
        api
    }

    pub(super) fn get<H: Handler<T, Arc<AppState>>, T: 'static>(self, path: &str, doc: Doc, handler: H) -> Api {
        self.add(path, HttpMethod::Get, doc, get(handler))
    }

    pub(super) fn post<H: Handler<T, Arc<AppState>>, T: 'static>(self, path: &str, doc: Doc, handler: H) -> Api {
        self.add(path, HttpMethod::Post, doc, post(handler))
    }

    pub(super) fn delete<H: Handler<T, Arc<AppState>>, T: 'static>(self, path: &str, doc: Doc, handler: H) -> Api {
        self.add(path, HttpMethod::Delete, doc, delete(handler))
    }

    fn add(mut self, path: &str, method: HttpMethod, doc: Doc, route: MethodRouter<Arc<AppState>>) -> Api {
        self.router = self.router.route(path, route);
        self.schemas.extend(doc.schemas);
        let text = || -> RefOr<Schema> { ObjectBuilder::new().schema_type(SchemaType::Type(Type::String)).into() };
        let parameter = |name: &str, place, description: Option<&str>| {
            let required = match description {
                None => Required::True,
                Some(_) => Required::False,
            };
            ParameterBuilder::new()
                .name(name)
                .parameter_in(place)
                .required(required)
                .description(description)
                .schema(Some(text()))
                .build()
        };
        let mut operation = OperationBuilder::new().summary(Some(doc.summary));
        let names = path.split(['{', '}']).skip(1).step_by(2);
        for name in names {
            operation = operation.parameter(parameter(name, ParameterIn::Path, None));
        }
        for (name, description) in doc.query {
            operation = operation.parameter(parameter(name, ParameterIn::Query, Some(description)));
        }
        if let Some(body) = doc.body {
            let content = ContentBuilder::new().schema(Some(body)).build();
            let body = RequestBodyBuilder::new()
                .content(JSON, content)
                .required(Some(Required::True));
            operation = operation.request_body(Some(body.build()));
        }
        let reply = ContentBuilder::new()
            .schema(Some(doc.reply.unwrap_or_else(text)))
            .build();
        let done = ResponseBuilder::new()
            .description("done")
            .content(doc.content_type, reply);
        operation = operation.response("200", done.build());
        let served = if doc.failure.is_some() { FAILURES.len() } else { 2 };
        for (status, description) in FAILURES.iter().take(served) {
            let error = RefOr::Ref(Ref::from_schema_name("ErrorReply"));
            let schema = match doc.failure.clone() {
                Some(failure) => RefOr::T(Schema::OneOf(OneOfBuilder::new().item(failure).item(error).build())),
                None => error,
            };
            let content = ContentBuilder::new().schema(Some(schema)).build();
            let response = ResponseBuilder::new().description(*description).content(JSON, content);
            operation = operation.response(*status, response.build());
        }
        self.paths.add_path_operation(path, vec![method], operation.build());
        self
    }

    /// All routes, including the one that serves their description.
    pub(super) fn finished(self) -> Router<Arc<AppState>> {
        let document = Arc::new(OnceLock::new());
        let text: Arc<OnceLock<String>> = document.clone();
        let served = async move || ([(CONTENT_TYPE, JSON)], document.get().cloned().unwrap_or_default());
        let api = self.get(PATH, Doc::any("This description"), served);
        let info = InfoBuilder::new()
            .title("drivegate")
            .version(drivegate_core::version::VERSION);
        let mut components = Components::new();
        components.schemas = api.schemas;
        let described = OpenApiBuilder::new()
            .info(info.build())
            .paths(api.paths)
            .components(Some(components))
            .build();
        // The document has only strings and numbers, so this cannot fail.
        text.get_or_init(|| serde_json::to_string(&described).unwrap_or_default());
        api.router
    }
}
