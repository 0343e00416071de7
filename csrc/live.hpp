template <class T>
void bind_live(nb::module_&, const std::string&) {}
